"""Reads every intact episode from the data files of a damaged dataset, independent of `meta`."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import Episode, schema
from egovcp.data.parquet import EPISODE_FEATURES, data_errors, open_data_file, to_numpy
from egovcp.data.paths import files_below
from egovcp.errors import DataError
from egovcp_collect.dataset.record_index import Record

_TIMESTAMP_TOLERANCE_S: Final = 1e-3  # timestamps are float32


@dataclass(frozen=True)
class RecoveredEpisode:
    """The rows of an episode without its record."""

    file: Path
    number: int
    """Its ``episode_index`` in the file."""
    arrays: dict[str, NDArray[Any]]

    def episode(self, record: Record) -> Episode:
        """The episode with the task, time limit and metadata of its record."""
        return Episode(
            **self.arrays,
            task=record["task"],
            time_limit=record["time_limit"],
            metadata=record.get("metadata", {}),
        )

    def digest(self) -> str:
        """`Episode.digest`, which does not depend on the record."""
        return self.episode({"task": "", "time_limit": 0}).digest()


def recover_episodes(root: Path) -> Iterator[RecoveredEpisode | DataError]:
    """The episodes of all data files in order, and an error for each unreadable part."""
    for path in files_below(root / "data"):
        if path.suffix == ".parquet":
            try:
                file = open_data_file(root, path)
            except DataError as error:
                yield error
            else:
                yield from _episodes(file, path)


def _episodes(file: pq.ParquetFile, path: Path) -> Iterator[RecoveredEpisode | DataError]:
    """The episodes of a file. They may span row groups, which are read one at a time."""
    number, parts = -1, list[pa.Table]()
    for group in range(file.num_row_groups):
        try:
            with data_errors(path):
                table = file.read_row_group(group, columns=[*schema.FEATURES], use_threads=False)
                runs = list(_split_by_episode(table))
        except DataError as error:
            lost = _episode_numbers(file, group)
            yield from (DataError.at(path, error.problem, n) for n in lost)
            if not lost:
                yield DataError.at(path, f"{error.problem} (row group {group})")
            parts = parts if number not in lost else []
            continue
        for run_number, part in runs:
            if run_number != number and parts:
                yield _assemble(path, number, parts)
                parts = []
            number = run_number
            parts.append(part)
    if parts:
        yield _assemble(path, number, parts)


def _split_by_episode(table: pa.Table) -> Iterator[tuple[int, pa.Table]]:
    """Consecutive rows with the same ``episode_index``."""
    numbers = to_numpy(table["episode_index"], "episode_index")
    edges = [0, *(np.flatnonzero(np.diff(numbers)) + 1).tolist(), len(numbers)]
    for first, last in itertools.pairwise(edges):
        if last > first:
            yield int(numbers[first]), table.slice(first, last - first)


def _episode_numbers(file: pq.ParquetFile, group: int) -> list[int]:
    """The episodes of a damaged row group, if that column is readable."""
    try:
        column = file.read_row_group(group, columns=["episode_index"], use_threads=False)[0]
        return sorted(set(column.to_pylist()))
    except (pa.ArrowException, OSError):
        return []


def _assemble(path: Path, number: int, parts: list[pa.Table]) -> RecoveredEpisode | DataError:
    try:
        with data_errors(path):
            table = pa.concat_tables(parts)
            columns = {name: to_numpy(table[name], name) for name in schema.FEATURES}
    except DataError as error:
        return DataError.at(path, error.problem or str(error), number, error.frame)
    frames = np.arange(len(table))
    late = np.abs(columns["timestamp"] - frames / spec.PLANNER_HZ)
    wrong = (columns["frame_index"] != frames) | ~(late <= _TIMESTAMP_TOLERANCE_S)
    if wrong.any():
        problem = f"its frame indices or timestamps do not count at {spec.PLANNER_HZ} Hz from 0"
        return DataError.at(path, problem, number, int(np.argmax(wrong)))
    arrays = {name: columns[key] for name, key in EPISODE_FEATURES.items()}
    return RecoveredEpisode(path, number, arrays)
