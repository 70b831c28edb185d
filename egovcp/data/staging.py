"""Encoded episodes, and the folder in which they wait to be committed to the dataset.

An encoded episode is an Arrow table in the types of the dataset's files, and its record. Its
position in the dataset (episode and frame index) is assigned when it is committed.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import dataset_files, schema, stats, tiff
from egovcp.data.episode import Episode
from egovcp.data.parquet import EPISODE_FEATURES
from egovcp.errors import DataError
from egovcp.files import sha256
from egovcp.robot_spec import G1, RobotSpec

_RECORD: Final = b"egovcp.facts"  # name in files of unfinished collections of older versions
_STATS: Final = b"egovcp.stats"
_ROBOT: Final = b"egovcp.robot"  # absent for the G1
_NAME: Final = re.compile(r"(\d{9})-([0-9a-f]{64})\.arrow")


@dataclass(frozen=True)
class EncodedEpisode:
    """A valid episode of T frames, ready to be written."""

    table: pa.Table
    """T rows of ``schema.episode_schema()``."""
    record: Mapping[str, Any]
    """The record in ``meta/collection.json``: task, length, time_limit, sha256, metadata."""
    stats: stats.Matrix
    """(R, D1) of `stats.data_stats`."""
    robot: RobotSpec = G1

    def __len__(self) -> int:
        return int(self.table.num_rows)


def encode(episode: Episode, where: str = "episode") -> EncodedEpisode:
    """Validate and encode an episode; ``where`` names it in errors (see `Episode.validate`)."""
    episode.validate(where)
    columns = _columns(episode)
    names = [f"frame-{i:06d}.tiff" for i in range(len(episode))]
    image = pa.StructArray.from_arrays(
        [tiff.encode(episode.depth), pa.array(names)], ["bytes", "path"]
    )
    arrays = {spec.DEPTH_KEY: image, **{key: _arrow(columns[key]) for key in schema.DATA_KEYS}}
    ordered = schema.episode_schema(episode.robot)
    record = {
        "task": episode.task,
        "length": len(episode),
        "time_limit": episode.time_limit,
        "sha256": episode.digest(),
        "metadata": dict(episode.metadata),
    }
    return EncodedEpisode(
        pa.Table.from_arrays([arrays[field.name] for field in ordered], schema=ordered),
        record,
        stats.data_stats(episode.depth, columns),
        episode.robot,
    )


def _columns(episode: Episode) -> dict[str, NDArray[np.generic]]:
    return {key: getattr(episode, name) for name, key in EPISODE_FEATURES.items()}


def _arrow(values: NDArray[np.generic]) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def with_index(
    encoded: EncodedEpisode, episode_index: int, first_frame: int, task_index: int
) -> tuple[pa.Table, stats.Matrix]:
    """The rows of a data file, and their statistics (R, D), at a position in the dataset."""
    columns = _index_columns(
        len(encoded), encoded.robot.planner_hz, episode_index, first_frame, task_index
    )
    ordered = schema.arrow_schema(encoded.robot)
    own = dict(zip(encoded.table.column_names, encoded.table.columns, strict=True))
    arrays = own | {key: pa.array(values) for key, values in columns.items()}
    table = pa.Table.from_arrays([arrays[field.name] for field in ordered], schema=ordered)
    return table, np.concatenate([encoded.stats, stats.index_stats(columns)], axis=1)


def _index_columns(
    length: int, hz: int, episode_index: int, first_frame: int, task_index: int
) -> dict[str, NDArray[np.generic]]:
    frames = np.arange(length, dtype=np.int64)
    return {
        "timestamp": (frames / hz).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full_like(frames, episode_index),
        "index": frames + first_frame,
        "task_index": np.full_like(frames, task_index),
    }


def episode_stats(episode: Episode) -> stats.Matrix:
    """The statistics (R, D) of a valid episode as the first of a dataset."""
    columns = _index_columns(len(episode), episode.robot.planner_hz, 0, 0, 0)
    data = stats.data_stats(episode.depth, _columns(episode))
    return np.concatenate([data, stats.index_stats(columns)], axis=1)


def to_bytes(encoded: EncodedEpisode) -> pa.Buffer:
    """One self-contained Arrow IPC file."""
    metadata = {
        _RECORD: json.dumps(dict(encoded.record), allow_nan=False).encode(),
        _STATS: np.ascontiguousarray(encoded.stats, dtype="<f8").tobytes(),
    }
    if not encoded.robot.is_g1:
        metadata[_ROBOT] = json.dumps(encoded.robot.to_json()).encode()
    sink = pa.BufferOutputStream()
    table = encoded.table.replace_schema_metadata(metadata)
    with pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue()


def from_buffer(buffer: pa.Buffer) -> EncodedEpisode:
    """The inverse of `to_bytes`, without a copy of the columns."""
    try:
        table = pa.ipc.open_file(buffer).read_all()
        metadata = table.schema.metadata or {}
        record = json.loads(metadata[_RECORD])
        matrix = np.frombuffer(metadata[_STATS], dtype="<f8").reshape(len(stats.ROWS), -1)
        robot = RobotSpec.from_json(json.loads(metadata[_ROBOT])) if _ROBOT in metadata else G1
    except (pa.ArrowException, KeyError, ValueError) as error:
        raise DataError(f"not a staged episode: {error}") from error
    return EncodedEpisode(table.replace_schema_metadata(None), record, matrix, robot)


class StagingDir:
    """A folder of staged episodes: one file each, complete or absent.

    A file's name holds the episode's number and the SHA-256 of its content.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def put(self, number: int, encoded: EncodedEpisode) -> None:
        """Write episode ``number`` of the collection atomically and flush it to the disk."""
        content = memoryview(to_bytes(encoded))
        name = f"{number:09d}-{hashlib.sha256(content).hexdigest()}.arrow"
        partial = self.folder / f".{name}.{os.getpid()}"
        try:
            dataset_files.create_file(partial, content)
            dataset_files.sync(partial)
            dataset_files.rename(partial, self.folder / name)
        except OSError:
            partial.unlink(missing_ok=True)
            raise
        dataset_files.sync(self.folder)

    def numbers(self) -> set[int]:
        return {number for number, _ in self._files()}

    def get(self, number: int) -> EncodedEpisode | None:
        """An episode, or None if it is missing or damaged; a damaged file is removed."""
        for path in self.folder.glob(f"{number:09d}-*.arrow"):
            found = _read(path)
            if found is not None:
                return found
            path.unlink(missing_ok=True)
        return None

    def drop_before(self, number: int) -> None:
        """Remove the episodes with lower numbers."""
        for found, path in self._files():
            if found < number:
                path.unlink(missing_ok=True)

    def remove_invalid(self) -> None:
        """Remove damaged episodes and partial files of interrupted writers."""
        for path in self.folder.glob(".*"):
            path.unlink(missing_ok=True)  # another process may remove it, too
        for _, path in self._files():
            if _read(path) is None:
                path.unlink(missing_ok=True)

    def _files(self) -> Iterator[tuple[int, Path]]:
        for path in sorted(self.folder.iterdir()):
            match = _NAME.fullmatch(path.name)
            if match:
                yield int(match[1]), path


def _read(path: Path) -> EncodedEpisode | None:
    """The episode in a staged file; None if its content does not match the hash in the file name,
    or another version of egovcp wrote it."""
    match = _NAME.fullmatch(path.name)
    if match is None or sha256(path) != match[2]:
        return None
    try:
        return from_buffer(pa.memory_map(str(path)).read_buffer())
    except DataError:
        return None
