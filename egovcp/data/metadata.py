"""Reads and checks a dataset's `meta` folder against the specification."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import schema
from egovcp.data.episode import EPISODE_FRAMES
from egovcp.data.parquet import damaged, open_parquet
from egovcp.data.paths import check_template, files_below, require_file
from egovcp.data.records import record_problems
from egovcp.errors import DataError
from egovcp.safe_files import JSON_LIMIT_BYTES, read_json

_EPISODE_COLUMNS = (
    "episode_index",
    "length",
    "data/chunk_index",
    "data/file_index",
    "dataset_from_index",
    "dataset_to_index",
)


_EPISODES: Final = 10_000_000
_TASKS: Final = 10_000
_RECORD_BYTES: Final = 32_768  # 20 times the record of an episode


@dataclass(frozen=True)
class EpisodeTable:
    """Where each of the E episodes lies; all arrays are (E,) int64."""

    length: NDArray[np.int64]
    chunk_index: NDArray[np.int64]
    file_index: NDArray[np.int64]
    start: NDArray[np.int64]
    """First global frame index."""


def load_info(root: Path) -> dict[str, Any]:
    """``meta/info.json``, checked against the specification.

    Raises:
        DataError: missing, damaged, or of another format, rate or feature set.
    """
    path = root / schema.INFO_PATH
    info = load_object(path, root)
    missing = {"codebase_version", "fps", "features", "total_episodes", "data_path"} - info.keys()
    if missing:
        raise DataError.at(path, f"lacks {', '.join(sorted(missing))}")
    if info["codebase_version"] != schema.CODEBASE_VERSION:
        raise DataError.at(
            path,
            f"LeRobot format {info['codebase_version']}, expected {schema.CODEBASE_VERSION}; "
            "convert it with LeRobot's own tools",
        )
    if info["fps"] != spec.PLANNER_HZ:
        raise DataError.at(path, f"{info['fps']} fps, expected {spec.PLANNER_HZ}")
    with damaged(path):
        _check_features(dict(info["features"]), path)
    check_template(info["data_path"], path)
    return info


def load_object(
    path: Path, root: Path | None = None, limit_bytes: int = JSON_LIMIT_BYTES
) -> dict[str, Any]:
    """A JSON file that holds an object; with ``root``, one that lies inside this folder."""
    if root is not None:
        require_file(root, path)
    with damaged(path):
        content = read_json(path, limit_bytes)
    if not isinstance(content, dict):
        raise DataError.at(path, f"holds a {type(content).__name__}, expected an object")
    return content


def _check_features(features: Mapping[str, Any], path: Path) -> None:
    for key, expected in schema.FEATURES.items():
        if key not in features:
            raise DataError.at(path, f"feature {key} is missing; found: {', '.join(features)}")
        found = dict(features[key])
        for field in ("dtype", "shape", "names"):
            have, want = _plain(found.get(field)), _plain(expected[field])
            if have != want:
                raise DataError.at(path, f"{key} has {field} {have}, expected {want}")
    info = dict(features[spec.DEPTH_KEY].get("info") or {})
    unit = info.get("depth_unit", schema.DEPTH_UNIT)
    if not info.get("is_depth_map") or unit != schema.DEPTH_UNIT:
        problem = f"{spec.DEPTH_KEY} is no depth map in {schema.DEPTH_UNIT}: {info}"
        raise DataError.at(path, problem)


def _plain(value: object) -> object:
    return list(value) if isinstance(value, list | tuple) else value


def load_episode_table(root: Path, info: Mapping[str, Any]) -> EpisodeTable:
    """``meta/episodes``, checked for consistency with itself and with ``info.json``."""
    paths = episode_files(root)
    parts = [_episode_columns(root, path) for path in paths]
    column = {name: np.concatenate([part[name] for part in parts]) for name in _EPISODE_COLUMNS}
    rows = np.cumsum([len(part["length"]) for part in parts])
    _check_episodes(column, info, root, lambda row: paths[int(np.searchsorted(rows, row, "right"))])
    return EpisodeTable(
        length=column["length"],
        chunk_index=column["data/chunk_index"],
        file_index=column["data/file_index"],
        start=column["dataset_from_index"],
    )


def episode_files(root: Path) -> list[Path]:
    """The files of the table of episodes, in order.

    Raises:
        DataError: there is none.
    """
    folder = root / "meta" / "episodes"
    paths = [path for path in files_below(folder) if path.suffix == ".parquet"]
    if not paths:
        raise DataError.at(folder, "holds no parquet file; the dataset is incomplete")
    return paths


def _episode_columns(root: Path, path: Path) -> dict[str, NDArray[np.int64]]:
    require_file(root, path)
    with damaged(path):
        table = open_parquet(path, _EPISODES).read(columns=list(_EPISODE_COLUMNS))
        for name in _EPISODE_COLUMNS:
            column = table[name]
            if column.null_count or not pa.types.is_integer(column.type):
                raise DataError.at(path, f"column {name} is {column.type}, expected whole numbers")
        return {name: table[name].to_numpy().astype(np.int64) for name in _EPISODE_COLUMNS}


def _check_episodes(
    column: Mapping[str, NDArray[np.int64]],
    info: Mapping[str, Any],
    root: Path,
    file_of: Callable[[int], Path],
) -> None:
    path, count = root / schema.INFO_PATH, len(column["episode_index"])
    if count == 0:
        raise DataError.at(file_of(-1), "lists no episode, expected at least one")
    if count != info["total_episodes"]:
        raise DataError.at(
            path, f"total_episodes is {info['total_episodes']}, but meta/episodes lists {count}"
        )
    ends = column["length"].cumsum()
    consistent = (
        (column["episode_index"] == np.arange(count))
        & (column["length"] > 0)
        & (column["length"] <= EPISODE_FRAMES)
        & (column["dataset_to_index"] == ends)
        & (column["dataset_from_index"] == ends - column["length"])
    )
    if not consistent.all():
        bad = int(np.argmin(consistent))
        problem = (
            "its index, length or frame range does not follow from the episodes before it, or it "
            f"has more than {EPISODE_FRAMES} frames"
        )
        raise DataError.at(file_of(bad), problem, bad)
    if int(ends[-1]) != info.get("total_frames"):
        raise DataError.at(
            path,
            f"total_frames is {info.get('total_frames')}, but meta/episodes adds to {ends[-1]}",
        )


def load_episode_stats(
    root: Path, feature: str, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and deviation of a feature in each of ``count`` episodes, (E, n) each.

    Raises:
        DataError: the table of episodes does not have them, or not for all.
    """
    folder = root / "meta" / "episodes"
    names = [f"stats/{feature}/{statistic}" for statistic in ("mean", "std")]
    paths = episode_files(root)
    with damaged(folder):
        tables = [open_parquet(path, _EPISODES).read(columns=names) for path in paths]
        table = pa.concat_tables(tables)
        mean, std = (np.array(table[name].to_pylist(), dtype=np.float64) for name in names)
    if len(mean) != count or not (np.isfinite(mean).all() and np.isfinite(std).all()):
        raise DataError.at(folder, f"the statistics of {feature} are not complete")
    return mean, std


def load_tasks(root: Path) -> dict[int, str]:
    """``meta/tasks.parquet``: task index -> task name."""
    path = root / schema.TASKS_PATH
    require_file(root, path)
    with damaged(path):
        table = open_parquet(path, _TASKS).read(columns=["task_index", "task"])
        numbers, names = table["task_index"].to_pylist(), table["task"].to_pylist()
    if not all(type(number) is int for number in numbers):
        raise DataError.at(path, f"column task_index is {table['task_index'].type}, expected int64")
    if not all(isinstance(name, str) for name in names):
        raise DataError.at(path, f"column task is {table['task'].type}, expected strings")
    if len(set(numbers)) != len(numbers) or len(set(names)) != len(names):
        raise DataError.at(path, f"lists a task twice: {names}, {numbers}")
    return dict(zip(numbers, names, strict=True))


def load_stats(root: Path) -> dict[str, Any]:
    """``meta/stats.json``: feature -> statistic -> values."""
    return load_object(root / schema.STATS_PATH, root)


def load_collection(root: Path, lengths: NDArray[np.int64]) -> dict[str, Any]:
    """``meta/collection.json``: provenance, and the record of each episode.

    Args:
        lengths: (E,) frames of each episode, as the table of episodes has them.
    """
    path = root / schema.COLLECTION_PATH
    if not path.exists() and not path.is_symlink():
        raise DataError.at(
            path,
            "missing: the low-level controller and the planned episode lengths are unknown. "
            "If LeRobot's tools made this dataset out of others, take the facts from those: "
            f"egovcp-dataset repair {root} --records=ORIGINAL --output_dir=NEW",
        )
    collection = load_object(path, root, JSON_LIMIT_BYTES + _RECORD_BYTES * len(lengths))
    if collection.get("spec_version") != spec.SPEC_VERSION:
        found = collection.get("spec_version")
        raise DataError.at(path, f"specification {found}, expected {spec.SPEC_VERSION}")
    for episode, problem in record_problems(collection.get("episodes"), lengths):
        raise DataError.at(path, problem, episode)
    return collection
