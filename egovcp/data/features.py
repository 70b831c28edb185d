"""Features of a LeRobot dataset, as ``meta/info.json`` describes them, and their values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from egovcp.data import schema
from egovcp.errors import DataError, SchemaError


@dataclass(frozen=True)
class Feature:
    """A feature of ``info.json``."""

    key: str
    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...]
    """Names of the values; empty unless each value has one."""
    is_depth: bool
    info: Mapping[str, Any] = field(default_factory=dict)
    """Properties of a camera: format of the video, unit of depth."""

    @property
    def is_camera(self) -> bool:
        return self.dtype in ("image", "video")

    @property
    def is_numeric(self) -> bool:
        """Whether its values are numbers or booleans."""
        return not self.is_camera and self.dtype not in ("string", "language")

    @property
    def size(self) -> int:
        """Values per frame."""
        return int(np.prod(self.shape))

    def label(self, index: int) -> str:
        """Name of the value at ``index``, ``"action[3] (gripper)"``."""
        place = self.key if self.size == 1 else f"{self.key}[{index}]"
        return f"{place} ({self.names[index]})" if self.names else place


def parse_feature(key: str, found: Mapping[str, Any]) -> Feature:
    """The feature ``key`` from its description in ``info.json``."""
    info = {**(found.get("video_info") or {}), **(found.get("info") or {})}
    depth = info.get("is_depth_map") or info.get("video.is_depth_map")
    shape = tuple(int(n) for n in found["shape"])
    names = tuple(map(str, _flat_names(found.get("names"))))
    size = int(np.prod(shape))
    names = names if len(names) == size else ()
    return Feature(key, str(found["dtype"]), shape, names, bool(depth), info)


def _flat_names(names: object) -> list[object]:
    """Names may be a list, or a dictionary of lists."""
    if isinstance(names, Mapping):
        return [name for part in names.values() for name in _flat_names(part)]
    return list(names) if isinstance(names, list | tuple) else []


def values_of(column: pa.ChunkedArray, feature: Feature) -> NDArray[Any]:
    """The column of a non-camera feature as (T, n), n values per frame.

    Raises:
        DataError: with `frame` set, a value is missing.
        SchemaError: with `frame` set, shape or type differs from the feature's.
    """
    array = column.combine_chunks()
    frames, levels, per_frame, key = len(array), 0, 1, feature.key
    while True:
        if isinstance(array, pa.ExtensionArray):
            array = array.storage
        if array.null_count:
            at = int(np.argmax(array.is_null().to_numpy(zero_copy_only=False)))
            raise DataError.without_place(f"{key} is null", at // per_frame)
        if not _is_list(array.type):
            break
        want = feature.shape[levels] if levels < len(feature.shape) else 0
        sizes = pc.list_value_length(array).to_numpy(zero_copy_only=False)
        if (sizes != want).any():
            at = int(np.argmax(sizes != want))
            given = f"{sizes[at]} values" if not levels else f"{sizes[at]} values at level {levels}"
            problem = f"{key} has {given}, but {schema.INFO_PATH} gives its shape as "
            problem += str(list(feature.shape))
            raise SchemaError.without_place(problem, at // per_frame)
        per_frame, levels, array = per_frame * want, levels + 1, array.flatten()
    if levels != len(feature.shape) and (levels, feature.size) != (0, 1):
        given = f"holds lists nested {levels} deep" if levels else "holds single values"
        problem = f"{key} {given}, but its shape is {list(feature.shape)}"
        raise SchemaError.without_place(problem, 0)
    if _kind(array.type) != _kind_of(feature.dtype):
        problem = f"{key} holds {array.type}, but its dtype is {feature.dtype}"
        raise SchemaError.without_place(problem, 0)
    return np.asarray(array.to_numpy(zero_copy_only=False)).reshape(frames, per_frame)


def nonfinite_problem(values: NDArray[Any], feature: Feature) -> tuple[int, str] | None:
    """Frame and description of the first NaN or infinity in the values (T, n) of a feature; None if
    all are finite."""
    if values.dtype.kind != "f" or (finite := np.isfinite(values)).all():
        return None
    at = int(np.argmin(finite.all(1)))
    index = int(np.argmin(finite[at]))
    return at, f"{feature.label(index)} is {values[at, index]}, expected a finite number"


def _is_list(kind: pa.DataType) -> bool:
    return bool(
        pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind)
    )


def _kind(kind: pa.DataType) -> str:
    """Kinds are what `datasets` converts into each other."""
    tests = {
        "float": pa.types.is_floating,
        "integer": pa.types.is_integer,
        "bool": pa.types.is_boolean,
        "string": lambda t: pa.types.is_string(t) or pa.types.is_large_string(t),
    }
    return next((name for name, test in tests.items() if test(kind)), str(kind))


def _kind_of(dtype: str) -> str:
    if dtype == "string":
        return dtype
    try:
        return {"f": "float", "i": "integer", "u": "integer", "b": "bool"}[np.dtype(dtype).kind]
    except (TypeError, KeyError):
        return f"unknown dtype {dtype}"
