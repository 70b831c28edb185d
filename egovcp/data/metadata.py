"""Reads and checks a dataset's `meta` folder against the specification."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import schema
from egovcp.errors import DataError

_EPISODE_COLUMNS = (
    "episode_index",
    "length",
    "data/chunk_index",
    "data/file_index",
    "dataset_from_index",
    "dataset_to_index",
)


@dataclass(frozen=True)
class EpisodeTable:
    """Where each of the E episodes lies; all arrays are (E,) int64."""

    length: NDArray[np.int64]
    chunk_index: NDArray[np.int64]
    file_index: NDArray[np.int64]
    start: NDArray[np.int64]
    """First global frame index."""


@contextmanager
def damaged(path: Path) -> Iterator[None]:
    """Turn what pyarrow and json say of a damaged file into a `DataError` that names it."""
    try:
        yield
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing; the dataset is incomplete") from error
    except (pa.ArrowException, json.JSONDecodeError, UnicodeDecodeError, KeyError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError(f"{path} is damaged: {reason}") from error
    except OSError as error:
        if error.errno is not None:
            raise
        raise DataError(f"{path} is damaged: {str(error).splitlines()[0]}") from error


def load_info(root: Path) -> dict[str, Any]:
    """``meta/info.json``, checked against the specification.

    Raises:
        DataError: missing, damaged, or of another format, rate or feature set.
    """
    path = root / schema.INFO_PATH
    info = load_object(path)
    missing = {"codebase_version", "fps", "features", "total_episodes", "data_path"} - info.keys()
    if missing:
        raise DataError(f"{path} lacks {', '.join(sorted(missing))}")
    if info["codebase_version"] != schema.CODEBASE_VERSION:
        raise DataError(
            f"{path}: LeRobot format {info['codebase_version']}, expected "
            f"{schema.CODEBASE_VERSION}; convert it with LeRobot's own tools"
        )
    if info["fps"] != spec.PLANNER_HZ:
        raise DataError(f"{path}: {info['fps']} fps, expected {spec.PLANNER_HZ}")
    _check_features(info["features"], path)
    _check_template(info["data_path"], path)
    return info


def load_object(path: Path) -> dict[str, Any]:
    """A JSON file that holds an object."""
    with damaged(path):
        content = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise DataError(f"{path} holds a {type(content).__name__}, expected an object")
    return content


def _check_features(features: Mapping[str, Any], path: Path) -> None:
    for key, expected in schema.FEATURES.items():
        found = features.get(key)
        if found is None:
            raise DataError(f"{path}: feature {key} is missing; found: {', '.join(features)}")
        for field in ("dtype", "shape", "names"):
            have, want = _plain(found.get(field)), _plain(expected[field])
            if have != want:
                raise DataError(f"{path}: {key} has {field} {have}, expected {want}")
    info = features[spec.DEPTH_KEY].get("info") or {}
    unit = info.get("depth_unit", schema.DEPTH_UNIT)
    if not info.get("is_depth_map") or unit != schema.DEPTH_UNIT:
        raise DataError(f"{path}: {spec.DEPTH_KEY} is no depth map in {schema.DEPTH_UNIT}: {info}")


def _plain(value: object) -> object:
    return list(value) if isinstance(value, list | tuple) else value


def _check_template(template: str, path: Path) -> None:
    if Path(template).is_absolute() or ".." in Path(template).parts:
        raise DataError(f"{path}: data_path {template!r} leads outside of the dataset")
    try:
        template.format(chunk_index=0, file_index=0)
    except (KeyError, IndexError, ValueError, AttributeError) as error:
        raise DataError(f"{path}: data_path {template!r} is no file template") from error


def load_episode_table(root: Path, info: Mapping[str, Any]) -> EpisodeTable:
    """``meta/episodes``, checked for consistency with itself and with ``info.json``."""
    folder = root / "meta" / "episodes"
    paths = sorted(folder.glob("*/*.parquet"))
    if not paths:
        raise DataError(f"{folder} holds no parquet file; the dataset is incomplete")
    tables = []
    for path in paths:
        with damaged(path):
            tables.append(pq.ParquetFile(path).read(columns=list(_EPISODE_COLUMNS)))
    with damaged(folder):
        table = pa.concat_tables(tables)
        column = {name: table[name].to_numpy() for name in _EPISODE_COLUMNS}
    _check_episodes(column, info, folder)
    return EpisodeTable(
        length=column["length"],
        chunk_index=column["data/chunk_index"],
        file_index=column["data/file_index"],
        start=column["dataset_from_index"],
    )


def _check_episodes(
    column: Mapping[str, NDArray[np.int64]], info: Mapping[str, Any], folder: Path
) -> None:
    count = len(column["episode_index"])
    if count == 0 or count != info["total_episodes"]:
        raise DataError(f"{folder}: {count} episodes, info.json says {info['total_episodes']}")
    ends = column["length"].cumsum()
    consistent = (
        (column["episode_index"] == np.arange(count))
        & (column["length"] > 0)
        & (column["dataset_to_index"] == ends)
        & (column["dataset_from_index"] == ends - column["length"])
    )
    if not consistent.all():
        bad = int(np.argmin(consistent))
        raise DataError(f"{folder}: the index, length or frame range of episode {bad} is wrong")
    if ends[-1] != info.get("total_frames"):
        raise DataError(f"{folder}: {ends[-1]} frames, info.json says {info.get('total_frames')}")


def load_tasks(root: Path) -> dict[int, str]:
    """``meta/tasks.parquet``: task index -> task name."""
    path = root / schema.TASKS_PATH
    with damaged(path):
        table = pq.ParquetFile(path).read(columns=["task_index", "task"])
        return dict(zip(table["task_index"].to_pylist(), table["task"].to_pylist(), strict=True))


def load_collection(root: Path, episodes: int) -> dict[str, Any]:
    """``meta/collection.json``: provenance, and the scenario of each episode."""
    path = root / schema.COLLECTION_PATH
    if not path.is_file():
        raise DataError(
            f"{path} is missing: the low-level controller and the planned episode lengths are "
            "unknown; was this dataset collected by egovcp-collect?"
        )
    collection = load_object(path)
    if collection.get("spec_version") != spec.SPEC_VERSION:
        raise DataError(
            f"{path}: specification {collection.get('spec_version')}, expected {spec.SPEC_VERSION}"
        )
    if len(collection.get("episodes", ())) != episodes:
        raise DataError(
            f"{path}: {len(collection.get('episodes', ()))} episodes, info.json says {episodes}"
        )
    if not collection.get("controller_id"):
        raise DataError(f"{path} names no low-level controller")
    return collection
