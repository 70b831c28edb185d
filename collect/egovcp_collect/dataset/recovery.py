"""Reads every intact episode from the data files of a damaged dataset, independent of `meta`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import Episode, schema
from egovcp.data.lerobot import episode_runs
from egovcp.data.parquet import (
    EPISODE_FEATURES,
    data_errors,
    open_data_file,
    present_columns,
    read_columns,
)
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
                names = present_columns(schema.FEATURES, file.schema_arrow.names)
                for found in episode_runs(file, path, names):
                    yield found if isinstance(found, DataError) else _assemble(path, *found)


def _assemble(path: Path, number: int, table: pa.Table) -> RecoveredEpisode | DataError:
    try:
        with data_errors(path):
            columns = read_columns(table, schema.FEATURES)
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
