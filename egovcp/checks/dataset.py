"""Is a dataset whole, true to its specification, and lined up in time?"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from egovcp import spec
from egovcp.checks.environment import COMMAND_TOLERANCE, commanded
from egovcp.cli import DatasetConfig
from egovcp.errors import DataError

if TYPE_CHECKING:
    from egovcp.data import DatasetReader, Episode

type Progress = Callable[[int, int], None]


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
    from egovcp.data.source import locate  # needs the extra egovcp[data]

    for error in dataset_problems(locate(config).root, progress):
        raise error


def dataset_problems(root: Path, progress: Progress | None = None) -> Iterator[DataError]:
    """Everything that is wrong with the dataset in the folder ``root``; no network.

    First the files (recorded hashes, none too many, none that lie elsewhere), then the `meta`
    folder, then each episode (schema, counts, times, values, recorded digest, and that the
    commands in its states line up with its actions, and that it is there once), at last the
    statistics.
    """
    from egovcp.checks.duplicates import DuplicateEpisodes
    from egovcp.checks.layout import file_problems, table_problems
    from egovcp.checks.statistics import EpisodeStatistics, StatisticsCheck
    from egovcp.data.metadata import hash_problems

    yield from _raised(hash_problems(root))
    reader = yield from _open(root)
    if reader is None:
        return
    yield from file_problems(reader)
    yield from _raised(table_problems(reader))
    duplicates = DuplicateEpisodes(reader)
    total, table = StatisticsCheck(reader), EpisodeStatistics(reader)
    for index in range(len(reader)):
        episode, problems = reader.inspect(index)
        yield from problems
        matrix = None
        if episode is not None and not problems:
            for frame, problem in command_problems(episode):
                yield DataError.at(reader.data_path(index), problem, index, frame)
            matrix = total.add(episode)
            yield from duplicates.problems(index, reader.digest(index) or episode.digest())
        yield from _raised(table.problems(index, matrix))
        if progress is not None:
            progress(index + 1, len(reader))
    yield from _raised(total.problems())


def _open(root: Path) -> Generator[DataError, None, DatasetReader | None]:
    """The reader; or None, after every problem that keeps it from opening."""
    from egovcp.data import DatasetReader, metadata
    from egovcp.data.source import Source

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
    """The problems, and the error that ended the search for more, if one did."""
    try:
        yield from problems
    except DataError as error:
        yield error


def command_problems(episode: Episode) -> Iterator[tuple[int, str]]:
    """Where the command in o_t is not a_{t-1} as sent, or the neutral pose at t = 0."""
    before = np.vstack([np.zeros((1, spec.ACTION_DIM)), episode.action[:-1]])
    off = np.abs(commanded(episode.state) - spec.ACTION_BOX.to_metric(before)).max(axis=1)
    wrong = np.flatnonzero(off > COMMAND_TOLERANCE)
    if len(wrong):
        t = int(wrong[0])
        yield (
            t,
            f"the command in the state is {off[t]:.3g} m from the action sent one tick before; the "
            "rows are shifted in time, or the action box differs",
        )
