"""Reads every intact episode from the data files of a damaged dataset, independent of `meta`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa

from egovcp.data import Episode, metadata, schema
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
from egovcp.robot_spec import G1, RobotSpec

_TIMESTAMP_TOLERANCE_S: Final = 1e-3  # timestamps are float32


class RecoveredEpisode(NamedTuple):
    """The rows of an episode without its record."""

    file: Path
    number: int  # its ``episode_index`` in the file
    episode: Episode  # without task, time limit and metadata, on which its digest does not depend


def recover_episodes(root: Path) -> Iterator[RecoveredEpisode | DataError]:
    """The episodes of all data files in order, and an error for each unreadable part."""
    robot = _robot(root)
    for path in files_below(root / "data"):
        if path.suffix == ".parquet":
            try:
                file = open_data_file(root, path, robot)
            except DataError as error:
                yield error
            else:
                names = present_columns(schema.FEATURES, file.schema_arrow.names)
                for found in episode_runs(file, path, names):
                    yield found if isinstance(found, DataError) else _assemble(path, *found, robot)


def _robot(root: Path) -> RobotSpec:
    """The robot of the dataset; the G1 if ``info.json`` cannot be read."""
    try:
        return metadata.load_robot(metadata.load_v3_info(root), root / schema.INFO_PATH)
    except DataError:
        return G1


def _assemble(
    path: Path, number: int, table: pa.Table, robot: RobotSpec
) -> RecoveredEpisode | DataError:
    try:
        with data_errors(path):
            columns = read_columns(table, schema.FEATURES, robot)
    except DataError as error:
        return DataError.at(path, error.problem or str(error), number, error.frame)
    frames = np.arange(len(table))
    late = np.abs(columns["timestamp"] - frames / robot.planner_hz)
    wrong = (columns["frame_index"] != frames) | ~(late <= _TIMESTAMP_TOLERANCE_S)
    if wrong.any():
        problem = f"its frame indices or timestamps do not count at {robot.planner_hz} Hz from 0"
        return DataError.at(path, problem, number, int(np.argmax(wrong)))
    arrays: dict[str, Any] = {name: columns[key] for name, key in EPISODE_FEATURES.items()}
    return RecoveredEpisode(path, number, Episode(**arrays, task="", time_limit=0, robot=robot))
