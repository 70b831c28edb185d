"""Conformance check of a dataset: files, tables, episodes, statistics, alignment in time."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from egovcp import spec
from egovcp.checks.environment import COMMAND_TOLERANCE, command_from_state
from egovcp.checks.lerobot_dataset import STALE, LeRobotCheck, Progress, lerobot_problems
from egovcp.checks.lerobot_episode import wrong_statistics
from egovcp.data import DatasetReader, Episode, metadata, schema, stats
from egovcp.data.features import Feature, parse_feature
from egovcp.data.lerobot import EpisodeRow, LeRobotReader, is_own
from egovcp.data.metadata import hash_problems
from egovcp.data.parquet import data_errors, open_parquet
from egovcp.data.paths import files_below, require_file
from egovcp.data.provenance import DuplicateFinder
from egovcp.data.source import Source, locate
from egovcp.data.staging import episode_stats
from egovcp.dataset_options import DatasetConfig
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
    table = LeRobotReader(root)
    check = LeRobotCheck(table)
    yield from table.problems
    yield from check.table_problems()
    yield from _task_problems(reader, table.rows)
    duplicates = DuplicateFinder[int]()
    matrices: list[stats.Matrix] = []
    for index in range(len(reader)):
        episode, problems = reader.inspect(index)
        yield from problems
        if episode is not None and not problems:
            for frame, problem in command_problems(episode):
                yield DataError.at(reader.data_path(index), problem, index, frame)
            matrices.append(episode_stats(episode))
            digest = reader.digest(index) or episode.digest()  # a recorded one has been compared
            yield from _duplicate_problems(reader, duplicates, index, digest)
            if index in check.by_number:
                row = check.by_number[index]
                yield from _episode_statistics_problems(reader, row, matrices[-1])
        if progress is not None:
            progress(index + 1, len(reader))
    if not table.problems:
        yield from _total_problems(reader, table.stats, matrices)


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


def _task_problems(reader: DatasetReader, rows: Sequence[EpisodeRow]) -> Iterator[DataError]:
    """Episodes whose tasks in ``meta/episodes`` and ``meta/collection.json`` differ."""
    for row in rows:
        if row.tasks != [reader.task(row.index)]:
            problem = f"its tasks are {row.tasks}, expected {reader.task(row.index)}"
            yield DataError.at(row.table_path, problem, row.index)


def _episode_statistics_problems(
    reader: DatasetReader, row: EpisodeRow, matrix: stats.Matrix
) -> Iterator[DataError]:
    """Differences of the statistics in ``meta/episodes`` from those (R, D) of the frames."""
    for feature, part in _checked(reader):
        found = row.stats(feature.key)
        for problem in _statistics_problems(found, matrix[:, part], row.length, feature):
            problem = f"statistics of {feature.key}: {problem}"
            yield DataError.at(row.table_path, problem, row.index)


def _total_problems(
    reader: DatasetReader, found: Mapping[str, Any], matrices: list[stats.Matrix]
) -> Iterator[DataError]:
    """Differences of ``meta/stats.json`` from the frames; ``matrices`` (R, D) are the statistics of
    the valid episodes."""
    path = reader.root / schema.STATS_PATH
    for key in reader.features:
        if not isinstance(found.get(key), dict):
            yield DataError.at(path, f"has no statistics of {key}")
    if len(matrices) != len(reader):
        return
    total = stats.aggregate(matrices, reader.lengths.tolist())
    for feature, part in _checked(reader):
        given = found.get(feature.key)
        if isinstance(given, dict):
            for problem in _statistics_problems(given, total[:, part], reader.num_frames, feature):
                yield DataError.at(path, f"{feature.key}: {problem}")


def _checked(reader: DatasetReader) -> Iterator[tuple[Feature, slice]]:
    """The features whose statistics are compared, and their columns of a matrix."""
    places, info = stats.layout(reader.robot), reader.info["features"]
    for key in reader.features:
        if key not in STALE:
            yield parse_feature(key, info[key]), places[key]


def _statistics_problems(
    found: Mapping[str, object], part: stats.Matrix, frames: int, feature: Feature
) -> Iterator[str]:
    expected = dict(zip(stats.ROWS, part, strict=True))
    scale = expected["max"] - expected["min"] + np.abs(expected["mean"])
    slacks = dict.fromkeys(expected, _RELATIVE * scale + _ABSOLUTE)
    yield from wrong_statistics(found, expected, slacks, feature)
    count = found.get("count")
    if count != [frames] or not isinstance(count, list) or isinstance(count[0], bool):
        yield f"count is {count!r:.80}, expected [{frames}]"
