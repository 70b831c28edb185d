"""Conformance check of a dataset: files, tables, episodes, statistics, alignment in time."""

from __future__ import annotations

import re
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from egovcp import spec
from egovcp.checks.environment import COMMAND_TOLERANCE, command_from_state
from egovcp.checks.statistics import EpisodeStatistics, StatisticsCheck
from egovcp.cli import DatasetConfig
from egovcp.data import DatasetReader, Episode, metadata, schema
from egovcp.data.metadata import hash_problems
from egovcp.data.parquet import data_errors, open_parquet
from egovcp.data.paths import files_below, require_file
from egovcp.data.provenance import DuplicateFinder
from egovcp.data.source import Source, locate
from egovcp.errors import DataError

type Progress = Callable[[int, int], None]

_RANGE = re.compile(r"(\d{1,18}):(\d{1,18})", re.ASCII)


def check_dataset(config: DatasetConfig, progress: Progress | None = None) -> None:
    """Check every file and every frame of a dataset; see `dataset_problems`.

    Args:
        config: the dataset.
        progress: called with (episodes done, episodes in all).

    Raises:
        UsageError: the configuration names no dataset.
        DataError: the first problem.
        EnvironmentFailure: the Hub cannot be reached.
    """
    for error in dataset_problems(locate(config).root, progress):
        raise error


def dataset_problems(root: Path, progress: Progress | None = None) -> Iterator[DataError]:
    """All problems of the dataset in the folder ``root``, without network access.

    Checked in this order: the files (recorded hashes, no additional files), the `meta` folder, each
    episode (schema, counts, times, values, recorded digest, commands that agree with the actions,
    no duplicate), and the statistics.
    """
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
    loaders = (metadata.load_info, metadata.load_tasks, metadata.load_stats)
    for load in loaders:
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
    """The first tick whose command in o_t is not a_{t-1} (the neutral pose at t = 0)."""
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
    yield from (DataError.at(path, text) for text in _split_problems(info, len(reader)))
    index = 0
    for file in metadata.episode_files(reader.root):
        with data_errors(file):
            listed = open_parquet(file).read(columns=["tasks"])["tasks"].to_pylist()
        for tasks in listed:
            if tasks != [reader.task(index)]:
                problem = f"its tasks are {tasks}, expected {reader.task(index)}"
                yield DataError.at(file, problem, index)
            index += 1


def _split_problems(info: dict[str, Any] | Any, episodes: int) -> Iterator[str]:
    splits = info.get("splits")
    if not isinstance(splits, dict) or not splits:
        yield f"splits is {splits!r}, expected ranges of episodes such as {{'train': '0:9'}}"
        return
    for name, text in splits.items():
        found = _RANGE.fullmatch(text) if isinstance(text, str) else None
        if found is None or not int(found[1]) <= int(found[2]) <= episodes:
            yield f"split {name} is {text!r}, expected a range within 0:{episodes}"
