"""Every episode that can still be read from the data files, whatever `meta` says."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import Episode, schema
from egovcp.data.parquet import EPISODE_FEATURES, data_errors, open_data_file, to_numpy
from egovcp.data.paths import files_below
from egovcp.errors import DataError

_TIMESTAMP_SLACK = 1e-3  # s; float32 timestamps


@dataclass(frozen=True)
class Found:
    """The rows of an episode, complete as far as they themselves can tell."""

    file: Path
    number: int
    """Its ``episode_index`` in the file."""
    arrays: dict[str, NDArray[Any]]

    def episode(self, record: dict[str, Any]) -> Episode:
        """The episode with the facts of its record."""
        return Episode(
            **self.arrays,
            task=record["task"],
            time_limit=record["time_limit"],
            metadata=record.get("metadata", {}),
        )

    def digest(self) -> str:
        """`Episode.digest`, which depends on no record."""
        return self.episode({"task": "", "time_limit": 0}).digest()


def salvage(root: Path) -> Iterator[Found | DataError]:
    """The episodes of all data files in order, and what could not be read."""
    for path in files_below(root / "data"):
        if path.suffix != ".parquet":
            continue
        try:
            file = open_data_file(root, path)
        except DataError as error:
            yield error
        else:
            yield from _episodes(file, path)


def _episodes(file: pq.ParquetFile, path: Path) -> Iterator[Found | DataError]:
    """One file, row group by row group; an episode may span several."""
    number, parts = -1, list[pa.Table]()
    for group in range(file.num_row_groups):
        try:
            with data_errors(path):
                table = file.read_row_group(group, columns=[*schema.FEATURES], use_threads=False)
                runs = list(_runs(table))
        except DataError as error:
            lost = _numbers(file, group)
            yield from (DataError.at(path, error.problem, n) for n in lost)
            if not lost:
                yield DataError.at(path, f"{error.problem} (row group {group})")
            parts = parts if number not in lost else []
            continue
        for found, part in runs:
            if found != number and parts:
                yield _assembled(path, number, parts)
                parts = []
            number = found
            parts.append(part)
    if parts:
        yield _assembled(path, number, parts)


def _runs(table: pa.Table) -> Iterator[tuple[int, pa.Table]]:
    """Stretches of rows with the same episode index."""
    numbers = to_numpy(table["episode_index"], "episode_index")
    edges = np.flatnonzero(np.diff(numbers)) + 1
    bounds = [0, *edges.tolist(), len(numbers)]
    for first, last in itertools.pairwise(bounds):
        if last > first:
            yield int(numbers[first]), table.slice(first, last - first)


def _numbers(file: pq.ParquetFile, group: int) -> list[int]:
    """The episodes of a damaged row group, if at least their numbers can be read."""
    try:
        column = file.read_row_group(group, columns=["episode_index"], use_threads=False)[0]
        return sorted(set(column.to_pylist()))
    except (pa.ArrowException, OSError):
        return []


def _assembled(path: Path, number: int, parts: list[pa.Table]) -> Found | DataError:
    try:
        with data_errors(path):
            table = pa.concat_tables(parts)
            columns = {name: to_numpy(table[name], name) for name in schema.FEATURES}
    except DataError as error:
        return DataError.at(path, error.problem or str(error), number, error.frame)
    frames = np.arange(len(table))
    wrong = columns["frame_index"] != frames
    wrong |= ~(np.abs(columns["timestamp"] - frames / spec.PLANNER_HZ) <= _TIMESTAMP_SLACK)
    if wrong.any():
        problem = f"its frames or their times do not count at {spec.PLANNER_HZ} Hz from 0"
        return DataError.at(path, problem, number, int(np.argmax(wrong)))
    return Found(path, number, {name: columns[key] for name, key in EPISODE_FEATURES.items()})
