"""Conformance check of a dataset: files, tables, episodes, statistics, alignment in time."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.checks.environment import COMMAND_TOLERANCE, command_from_state
from egovcp.checks.feature_statistics import numbers_in
from egovcp.checks.lerobot_dataset import STALE, Progress, lerobot_problems, split_problems
from egovcp.cli import DatasetConfig
from egovcp.data import DatasetReader, Episode, metadata, schema, stats
from egovcp.data.lerobot import is_own
from egovcp.data.metadata import hash_problems
from egovcp.data.parquet import EPISODE_FEATURES, data_errors, open_parquet
from egovcp.data.paths import files_below, require_file
from egovcp.data.provenance import DuplicateFinder
from egovcp.data.source import Source, locate
from egovcp.errors import DataError

_RELATIVE = 1e-4  # of the column's range: statistics may be float32
_ABSOLUTE = 1e-6


def check_dataset(config: DatasetConfig, progress: Progress | None = None) -> None:
    """Check every file and frame of a dataset; raises the first of its `dataset_problems`.

    ``progress`` is called with the number of episodes done, and of all.
    """
    for error in dataset_problems(locate(config).root, progress):
        raise error


def dataset_problems(
    root: Path, progress: Progress | None = None, notes: list[str] | None = None
) -> Iterator[DataError]:
    """All problems of the dataset in the folder ``root``, without network access.

    A dataset of another origin (see `is_own`) is checked by `lerobot_problems`, which appends what
    it does not check to ``notes``. One of egovcp's is checked in this order: the files (recorded
    hashes, no additional files), the `meta` folder, each episode (schema, counts, times, values,
    recorded digest, commands that agree with the actions, no duplicate), and the statistics.
    """
    if not is_own(root):
        yield from lerobot_problems(root, progress, notes)
        return
    yield from _raised(hash_problems(root))
    reader = yield from _open(root)
    if reader is None:
        return
    yield from _file_problems(reader)
    yield from _raised(_table_problems(reader))
    duplicates = DuplicateFinder[int]()
    total, table = StatisticsCheck(reader), EpisodeStatistics(reader)
    for index in range(len(reader)):
        episode, problems = reader.inspect(index)
        yield from problems
        matrix = None
        if episode is not None and not problems:
            for frame, problem in command_problems(episode):
                yield DataError.at(reader.data_path(index), problem, index, frame)
            matrix = total.add(episode)
            digest = reader.digest(index) or episode.digest()
            yield from _duplicate_problems(reader, duplicates, index, digest)
        yield from _raised(table.problems(index, matrix))
        if progress is not None:
            progress(index + 1, len(reader))
    yield from _raised(total.problems())


def _open(root: Path) -> Generator[DataError, None, DatasetReader | None]:
    """The reader; None after all problems that prevent opening it."""
    try:
        return DatasetReader(Source(root, ""))
    except DataError as error:
        first = error
    yield first
    for load in (metadata.load_info, metadata.load_tasks, metadata.load_stats):
        try:
            load(root)
        except DataError as error:
            if str(error) != str(first):
                yield error
    return None


def _raised(problems: Iterator[DataError]) -> Iterator[DataError]:
    """The problems, and the error that ended their iteration, if any."""
    try:
        yield from problems
    except DataError as error:
        yield error


def command_problems(episode: Episode) -> Iterator[tuple[int, str]]:
    """The first tick whose command in o_t is not a_{t-1} (the neutral pose at t = 0); of the G1."""
    if not episode.robot.is_g1:
        return
    before = np.vstack([np.zeros((1, spec.ACTION_DIM)), episode.action[:-1]])
    off = np.abs(command_from_state(episode.state) - spec.ACTION_BOX.to_metric(before)).max(axis=1)
    wrong = np.flatnonzero(off > COMMAND_TOLERANCE)
    if len(wrong):
        t = int(wrong[0])
        yield (
            t,
            f"the command in the state is {off[t]:.3g} m from the action sent one tick before; the "
            "rows are shifted in time, or the action box differs",
        )


def _duplicate_problems(
    reader: DatasetReader, finder: DuplicateFinder[int], index: int, digest: str
) -> Iterator[DataError]:
    """The problem of an episode that repeats an earlier one."""
    try:
        scenario = reader.scenario(index)
    except DataError as error:
        yield error
        return
    found = finder.add(index, digest, scenario)
    if found is not None:
        path = reader.data_path(index) if found.equal else reader.root / schema.COLLECTION_PATH
        yield DataError.at(path, found.problem(scenario), index)


def _file_problems(reader: DatasetReader) -> Iterator[DataError]:
    """Data files that are missing, have the wrong size, or are not listed.

    LeRobot and `datasets` read every file in ``data``, listed or not.
    """
    expected = reader.frames_per_file
    for path, frames in expected.items():
        try:
            yield from _content_problems(reader, path, frames)
        except DataError as error:
            yield error if error.file else DataError.at(path, str(error))
    for path in files_below(reader.root / "data"):
        if path not in expected:
            problem = "listed in no table, yet LeRobot and `datasets` would read it; remove it"
            yield DataError.at(path, problem)


def _content_problems(reader: DatasetReader, path: Path, frames: int) -> Iterator[DataError]:
    require_file(reader.root, path)
    with data_errors(path):
        file = open_parquet(path)
        rows, columns = file.metadata.num_rows, set(file.schema_arrow.names)
    if rows != frames:
        yield DataError.at(path, f"holds {rows} frames, but meta/episodes lists {frames}")
    unknown = sorted(columns - set(reader.info["features"]))
    if unknown:
        problem = f"columns that {schema.INFO_PATH} does not know: {', '.join(unknown)}"
        yield DataError.at(path, problem)


def _table_problems(reader: DatasetReader) -> Iterator[DataError]:
    """Tasks and splits that do not agree with the episodes."""
    path, info = reader.root / schema.INFO_PATH, reader.info
    if info.get("total_tasks") != len(reader.task_names):
        found = f"total_tasks is {info.get('total_tasks')}"
        yield DataError.at(path, f"{found}, but {schema.TASKS_PATH} lists {len(reader.task_names)}")
    yield from (DataError.at(path, text) for text in split_problems(info, len(reader)))
    index = 0
    for file in metadata.episode_files(reader.root):
        with data_errors(file):
            listed = open_parquet(file).read(columns=["tasks"])["tasks"].to_pylist()
        for tasks in listed:
            if tasks != [reader.task(index)]:
                problem = f"its tasks are {tasks}, expected {reader.task(index)}"
                yield DataError.at(file, problem, index)
            index += 1


class StatisticsCheck:
    """Compares ``meta/stats.json`` with the statistics of all frames."""

    def __init__(self, reader: DatasetReader) -> None:
        self._reader = reader
        self._frames = 0
        self._total: stats.Matrix | None = None

    def add(self, episode: Episode) -> stats.Matrix:
        """Add a valid episode; returns the statistics (R, D) of its frames."""
        matrix = _statistics(self._reader, episode)
        parts = [matrix] if self._total is None else [self._total, matrix]
        counts = [len(episode)] if self._total is None else [self._frames, len(episode)]
        self._total = stats.aggregate(parts, counts)
        self._frames += len(episode)
        return matrix

    def problems(self) -> Iterator[DataError]:
        """Differences from ``meta/stats.json``, if all frames of the dataset were added."""
        path = self._reader.root / schema.STATS_PATH
        found = self._reader.stats
        for key in self._reader.features:
            if not isinstance(found.get(key), dict):
                yield DataError.at(path, f"has no statistics of {key}")
        if self._total is None or self._frames != self._reader.num_frames:
            return
        places = stats.layout(self._reader.robot)
        for key in _checked(self._reader):
            if isinstance(found.get(key), dict):
                for problem in _differences(found[key], self._total[:, places[key]], self._frames):
                    yield DataError.at(path, f"{key}: {problem}")


class EpisodeStatistics:
    """Compares the statistics in ``meta/episodes`` with the frames, file by file."""

    def __init__(self, reader: DatasetReader) -> None:
        self._reader = reader
        self._rows = self._all_rows()

    def problems(self, index: int, matrix: stats.Matrix | None) -> Iterator[DataError]:
        """Differences from the table's row of an episode; call it for every episode in order.

        ``matrix`` are the statistics (R, D) of its frames; None: unknown.
        """
        found_row = next(self._rows, None)
        if found_row is None or matrix is None:
            return
        path, row = found_row
        places = stats.layout(self._reader.robot)
        for key in _checked(self._reader):
            prefix = f"stats/{key}/"
            found = {k.removeprefix(prefix): v for k, v in row.items() if k.startswith(prefix)}
            length = int(self._reader.lengths[index])
            for problem in _differences(found, matrix[:, places[key]], length):
                yield DataError.at(path, f"statistics of {key}: {problem}", index)

    def _all_rows(self) -> Iterator[tuple[Any, Mapping[str, Any]]]:
        for path in metadata.episode_files(self._reader.root):
            with data_errors(path):
                file = open_parquet(path)
                names = [n for n in file.schema_arrow.names if n.startswith("stats/")]
                for group in range(file.num_row_groups):
                    for row in file.read_row_group(group, columns=names).to_pylist():
                        yield path, row


def _checked(reader: DatasetReader) -> Iterator[str]:
    """The features whose statistics are compared."""
    return (key for key in reader.features if key not in STALE)


def _statistics(reader: DatasetReader, episode: Episode) -> stats.Matrix:
    columns = {key: getattr(episode, name) for name, key in EPISODE_FEATURES.items()}
    depth = columns.pop(spec.DEPTH_KEY)
    frames = np.arange(len(episode), dtype=np.int64)
    places: dict[str, NDArray[np.generic]] = {
        **dict.fromkeys(schema.INDEX_FEATURES, frames),  # those in STALE are not compared
        "timestamp": (frames / reader.fps).astype(np.float32),
    }
    return np.concatenate([stats.data_stats(depth, columns), stats.index_stats(places)], axis=1)


def _differences(found: Mapping[str, object], part: stats.Matrix, frames: int) -> Iterator[str]:
    least, most, mean = part[0], part[1], part[2]
    slack = _RELATIVE * (most - least + np.abs(mean)) + _ABSOLUTE
    for name, expected in zip(stats.ROWS, part, strict=True):
        values = numbers_in(found.get(name))
        if values is None or values.shape != expected.shape:
            yield f"{name} is missing or has not {len(expected)} numbers"
        elif not (np.abs(values - expected) <= slack).all():
            at = int(np.argmax(~(np.abs(values - expected) <= slack)))
            yield f"{name} of value {at} is {values[at]:.6g}, its frames have {expected[at]:.6g}"
    count = found.get("count")
    if count != [frames] or not isinstance(count, list) or isinstance(count[0], bool):
        yield f"count is {count!r:.80}, expected [{frames}]"
