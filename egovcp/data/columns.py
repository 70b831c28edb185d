"""The columns of a data file as arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import schema, tiff
from egovcp.data.parquet import damaged, open_parquet
from egovcp.data.paths import require_file
from egovcp.errors import DataError

type Columns = dict[str, NDArray[Any]]


def open_data_file(root: Path, path: Path) -> pq.ParquetFile:
    """A data file of the dataset at ``root``.

    Raises:
        DataError: it is missing, damaged, lies elsewhere, or has columns of other types.
    """
    require_file(root, path)
    file = open_parquet(path)
    with damaged(path):
        for problem in schema.type_problems(file.schema_arrow):
            raise DataError.at(path, problem)
    return file


def to_numpy(column: pa.ChunkedArray, name: str) -> NDArray[Any]:
    """A column (T,) or (T, n), or depth (T, 48, 64), in the type of its feature.

    Raises:
        DataError: with the frame whose value is empty, of another length, or no image.
    """
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays(array.chunks)
    if array.null_count:
        empty = array.is_null().to_numpy(zero_copy_only=False)
        raise _at(int(np.argmax(empty)), f"column {name} is empty")
    if name == spec.DEPTH_KEY:
        return tiff.decode(array.field("bytes"), spec.DEPTH_ROWS, spec.DEPTH_COLS)
    dtype, width = str(schema.FEATURES[name]["dtype"]), schema.width(name)
    if width == 1:
        return np.asarray(array.to_numpy(zero_copy_only=False), dtype=dtype)
    sizes = pc.list_value_length(array).to_numpy()
    if (sizes != width).any():
        at = int(np.argmax(sizes != width))
        raise _at(at, f"column {name} has {sizes[at]} values, expected {width}")
    flat = array.flatten().to_numpy(zero_copy_only=False)
    return np.asarray(flat.reshape(len(array), width), dtype=dtype)


def _at(frame: int, problem: str) -> DataError:
    error = DataError(problem)
    error.frame = frame
    return error


#: Array of an episode -> the feature that holds it.
EPISODE_FEATURES = {
    "depth": spec.DEPTH_KEY,
    "state": spec.STATE_KEY,
    "action": spec.ACTION_KEY,
    "reward": spec.REWARD_KEY,
    "done": spec.DONE_KEY,
    "success": spec.SUCCESS_KEY,
    "truncated": spec.TRUNCATED_KEY,
}
