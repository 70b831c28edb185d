"""Reads a dataset's `meta` folder, checked against the specification and the list of hashes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import schema
from egovcp.data.episode import EPISODE_FRAMES
from egovcp.data.parquet import data_errors, open_parquet
from egovcp.data.paths import check_template, files_below, require_file
from egovcp.decode import DecodeError
from egovcp.errors import DataError
from egovcp.files import JSON_LIMIT_BYTES, read_json, sha256
from egovcp.robot_spec import G1, ROBOT_KEY, RobotSpec

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
_NUMBERS: Final = ("seed", "episode", "event_tick", "camera_pitch")  # in the metadata, optional
_LARGEST_LIMIT: Final = 2**31 - 1
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
#: Column of the task names if their index has no name, as in files of LeRobot 0.4.
_UNNAMED_INDEX: Final = "__index_level_0__"
#: Folders in which every file must be listed in ``meta/sha256.json``, but for `_UNLISTED`.
_HASHED = ("data", "meta")
_UNLISTED = (schema.HASHES_PATH, schema.SOURCE_PATH)
_LIST_BYTES: Final = 256 << 20  # 10^6 shards
_OTHER_BYTES: Final = 1 << 30


@dataclass(frozen=True)
class EpisodeTable:
    """Position of each of the E episodes; all arrays are (E,) int64."""

    length: NDArray[np.int64]
    chunk_index: NDArray[np.int64]
    file_index: NDArray[np.int64]
    start: NDArray[np.int64]
    """First global frame index."""


def load_info(root: Path) -> dict[str, Any]:
    """``meta/info.json``, checked against format, rate and features of its robot."""
    info, path = load_v3_info(root), root / schema.INFO_PATH
    robot = load_robot(info, path)
    if info["fps"] != robot.planner_hz:
        raise DataError.at(path, f"{info['fps']} fps, expected {robot.planner_hz}")
    with data_errors(path):
        _check_features(dict(info["features"]), path, robot)
    return info


def load_robot(info: Mapping[str, Any], path: Path) -> RobotSpec:
    """The robot that ``info.json``, at ``path``, describes; without an entry, the G1."""
    if ROBOT_KEY not in info:
        return G1
    try:
        return RobotSpec.from_json(info[ROBOT_KEY])
    except DecodeError as error:
        raise DataError.at(path, str(error)) from error


def load_v3_info(root: Path) -> dict[str, Any]:
    """``meta/info.json`` of a LeRobot v3 dataset of any features."""
    path = root / schema.INFO_PATH
    info = load_json_object(path, root)
    missing = {"codebase_version", "fps", "features", "total_episodes", "data_path"} - info.keys()
    if missing:
        raise DataError.at(path, f"lacks {', '.join(sorted(missing))}")
    if info["codebase_version"] != schema.CODEBASE_VERSION:
        raise DataError.at(
            path,
            f"LeRobot format {info['codebase_version']}, expected {schema.CODEBASE_VERSION}; "
            "convert it with LeRobot's convert_dataset_v21_to_v30",
        )
    fps, features = info["fps"], info["features"]
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps < 1e5:
        raise DataError.at(path, f"fps is {fps!r}, expected a positive number")
    if not isinstance(features, dict):
        raise DataError.at(path, f"features is a {type(features).__name__}, expected an object")
    for key, feature in features.items():
        shape = feature.get("shape") if isinstance(feature, dict) else None
        sizes = isinstance(shape, list) and all(type(n) is int and n > 0 for n in shape)
        if not (shape and sizes and isinstance(feature.get("dtype"), str)):
            raise DataError.at(path, f"feature {key} is {feature!r:.80}, expected dtype and shape")
    check_template(info["data_path"], path)
    if any(feature["dtype"] == "video" for feature in features.values()):
        check_template(info.get("video_path"), path, "videos")
    return info


def load_json_object(
    path: Path, root: Path | None = None, limit_bytes: int = JSON_LIMIT_BYTES
) -> dict[str, Any]:
    """Read a JSON file that holds an object; with ``root``, the file must be inside that folder."""
    if root is not None:
        require_file(root, path)
    with data_errors(path):
        content = read_json(path, limit_bytes)
    if not isinstance(content, dict):
        raise DataError.at(path, f"holds a {type(content).__name__}, expected an object")
    return content


def _check_features(features: Mapping[str, Any], path: Path, robot: RobotSpec) -> None:
    for key, expected in schema.features_of(robot).items():
        if key not in features and key in spec.OPTIONAL_KEYS:
            continue
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
        problem = f"{spec.DEPTH_KEY} is not a depth map in {schema.DEPTH_UNIT}: {info}"
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
    names = ("length", "data/chunk_index", "data/file_index", "dataset_from_index")
    return EpisodeTable(*(column[name] for name in names))


def episode_files(root: Path) -> list[Path]:
    """The files of the episodes table, in order; raises `DataError` if there is none."""
    folder = root / "meta" / "episodes"
    paths = [path for path in files_below(folder) if path.suffix == ".parquet"]
    if not paths:
        raise DataError.at(folder, "holds no parquet file; the dataset is incomplete")
    return paths


def _episode_columns(root: Path, path: Path) -> dict[str, NDArray[np.int64]]:
    require_file(root, path)
    with data_errors(path):
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
    """Mean and standard deviation of a feature in each of ``count`` episodes, (E, n) each."""
    folder = root / "meta" / "episodes"
    names = [f"stats/{feature}/{statistic}" for statistic in ("mean", "std")]
    paths = episode_files(root)
    with data_errors(folder):
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
    with data_errors(path):
        file = open_parquet(path, _TASKS)
        found = file.schema_arrow.names
        key = _UNNAMED_INDEX if _UNNAMED_INDEX in found and "task" not in found else "task"
        table = file.read(columns=["task_index", key])
        numbers, names = table["task_index"].to_pylist(), table[key].to_pylist()
    if not all(type(number) is int for number in numbers):
        raise DataError.at(path, f"column task_index is {table['task_index'].type}, expected int64")
    if not all(isinstance(name, str) for name in names):
        raise DataError.at(path, f"column {key} is {table[key].type}, expected strings")
    if len(set(numbers)) != len(numbers) or len(set(names)) != len(names):
        raise DataError.at(path, f"lists a task twice: {names}, {numbers}")
    return dict(zip(numbers, names, strict=True))


def load_stats(root: Path) -> dict[str, Any]:
    """``meta/stats.json``: feature -> statistic -> values."""
    return load_json_object(root / schema.STATS_PATH, root)


def load_collection(root: Path, lengths: NDArray[np.int64]) -> dict[str, Any]:
    """``meta/collection.json``: provenance and episode records; ``lengths`` (E,) are in frames."""
    path = root / schema.COLLECTION_PATH
    if not path.exists() and not path.is_symlink():
        raise DataError.at(
            path,
            "missing: the low-level controller and the planned episode lengths are unknown. "
            "If LeRobot's tools made this dataset from others, copy the records from those: "
            f"egovcp-dataset repair {root} --records=ORIGINAL --output_dir=NEW",
        )
    collection = load_json_object(path, root, JSON_LIMIT_BYTES + _RECORD_BYTES * len(lengths))
    if collection.get("spec_version") != spec.SPEC_VERSION:
        found = collection.get("spec_version")
        raise DataError.at(path, f"specification {found}, expected {spec.SPEC_VERSION}")
    records = collection.get("episodes")
    if not isinstance(records, list):
        kind = type(records).__name__
        raise DataError.at(path, f"episodes is a {kind}, expected a list")
    if len(records) != len(lengths):
        problem = f"records {len(records)} episodes, but meta/episodes lists {len(lengths)}"
        raise DataError.at(path, problem)
    for index, record in enumerate(records):
        for problem in record_problems(record, int(lengths[index])):
            raise DataError.at(path, problem, index)
    return collection


def record_problems(record: object, length: int | None = None) -> Iterator[str]:
    """Problems of the record of an episode with ``length`` frames; None: any number."""
    if not isinstance(record, Mapping):
        yield f"its record is a {type(record).__name__}, expected an object"
        return
    task, limit, digest = record.get("task"), record.get("time_limit"), record.get("sha256", "")
    if not isinstance(task, str) or not task:
        yield f"its task is {task!r}, expected a name"
    if not isinstance(limit, int) or isinstance(limit, bool) or not 0 < limit <= _LARGEST_LIMIT:
        yield f"its time_limit is {limit!r}, expected 1 to {_LARGEST_LIMIT} ticks"
    if not isinstance(digest, str) or (digest and not _DIGEST.fullmatch(digest)):
        yield f"its sha256 is {digest!r}, expected 64 hexadecimal digits"
    facts = record.get("metadata", {})
    if isinstance(facts, Mapping):
        yield from _metadata_problems(facts)
    else:
        yield "its metadata is not an object"
    if length is not None and record.get("length", length) != length:
        yield f"its record says {record['length']} frames, but meta/episodes says {length}"


def _metadata_problems(facts: Mapping[str, Any]) -> Iterator[str]:
    """Values of a wrong type, of those that are read; `decode` would take a second for a dataset of
    10 000 episodes."""
    for name in _NUMBERS:
        if not isinstance(facts.get(name), int | float | None):
            yield f"its {name} is {facts[name]!r}, expected a number"
    terms, ticks = (facts.get(name, {}) for name in ("reward_terms", "contact_ticks"))
    sums = terms.values() if isinstance(terms, Mapping) else [terms]
    if not all(isinstance(term, Mapping) and term.keys() >= {"ticks", "sum"} for term in sums):
        yield "its reward_terms are not objects with ticks and sum"
    if not isinstance(ticks, Mapping) or not all(isinstance(n, int) for n in ticks.values()):
        yield "its contact_ticks are not integers"


def load_hashes(root: Path) -> Mapping[str, str]:
    """Relative path -> SHA-256; empty for a dataset written by other tools."""
    path = root / schema.HASHES_PATH
    if not path.exists():
        return {}
    require_file(root, path)
    hashes = load_json_object(path, limit_bytes=_LIST_BYTES)
    if not hashes or not all(isinstance(value, str) for value in hashes.values()):
        raise DataError.at(path, "expected the SHA-256 of each file")
    return hashes


def hashed_files(root: Path) -> list[str]:
    """Relative paths of the files that must be listed, sorted."""
    found = (
        path.relative_to(root).as_posix()
        for folder in _HASHED
        for path in files_below(root / folder)
    )
    return sorted(set(found) - set(_UNLISTED))


def verify_hashes(root: Path) -> None:
    """Raise the first of `hash_problems`."""
    for error in hash_problems(root):
        raise error


def hash_problems(root: Path) -> Iterator[DataError]:
    """Every file that is missing, not listed, or different; empty without a list."""
    hashes = load_hashes(root)
    present = set(hashed_files(root)) if hashes else set()
    for name in sorted({*hashes, *present}):
        if name not in hashes:
            yield DataError.at(root / name, f"not listed in {schema.HASHES_PATH}; remove it")
        elif name not in present:
            yield DataError.at(root / name, "missing; the dataset is incomplete")
        else:
            yield from _difference(root, name, hashes[name])


def _difference(root: Path, name: str, expected: str) -> Iterator[DataError]:
    path = root / name
    try:
        require_file(root, path)
        if path.suffix == ".parquet":
            open_parquet(path)  # rejects huge sparse files, which would take hours to hash
        with data_errors(path):
            found = sha256(path, None if path.suffix == ".parquet" else _OTHER_BYTES)
    except DataError as error:
        yield error
        return
    if found != expected:
        yield DataError.at(
            root / name, f"damaged: its SHA-256 is not the one in {schema.HASHES_PATH}"
        )
