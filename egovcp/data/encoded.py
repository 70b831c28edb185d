"""An episode in the form in which it is sealed, sent and committed: an Arrow table and its facts.

The table has the columns that the episode itself holds, in the types of the dataset's files; which
episode and frame of the dataset they become is known only when they are committed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import schema, stats, tiff
from egovcp.data.episode import Episode
from egovcp.errors import DataError

_FACTS: Final = b"egovcp.facts"
_STATS: Final = b"egovcp.stats"


@dataclass(frozen=True)
class EncodedEpisode:
    """A valid episode of T frames, ready to be written."""

    table: pa.Table
    """T rows of ``schema.episode_schema()``."""
    facts: Mapping[str, Any]
    """The record of ``meta/collection.json``: task, length, time_limit, sha256, metadata."""
    stats: stats.Matrix
    """(R, D1) of `stats.data_stats`."""

    def __len__(self) -> int:
        return int(self.table.num_rows)


def encode(episode: Episode, where: str = "episode") -> EncodedEpisode:
    """Validate and encode an episode.

    Raises:
        DataError: it is not valid (see `Episode.validate`); ``where`` names it.
    """
    episode.validate(where)
    columns: dict[str, NDArray[np.generic]] = {
        spec.STATE_KEY: episode.state,
        spec.ACTION_KEY: episode.action,
        spec.REWARD_KEY: episode.reward,
        spec.DONE_KEY: episode.done,
        spec.SUCCESS_KEY: episode.success,
        spec.TRUNCATED_KEY: episode.truncated,
    }
    names = [f"frame-{i:06d}.tiff" for i in range(len(episode))]
    image = pa.StructArray.from_arrays(
        [tiff.encode(episode.depth), pa.array(names)], ["bytes", "path"]
    )
    arrays = {spec.DEPTH_KEY: image, **{key: _arrow(columns[key]) for key in schema.DATA_KEYS}}
    ordered = schema.episode_schema()
    facts = {
        "task": episode.task,
        "length": len(episode),
        "time_limit": episode.time_limit,
        "sha256": episode.digest(),
        "metadata": dict(episode.metadata),
    }
    return EncodedEpisode(
        pa.Table.from_arrays([arrays[field.name] for field in ordered], schema=ordered),
        facts,
        stats.data_stats(episode.depth, columns),
    )


def to_bytes(encoded: EncodedEpisode) -> pa.Buffer:
    """One self-contained Arrow IPC file."""
    metadata = {
        _FACTS: json.dumps(dict(encoded.facts), allow_nan=False).encode(),
        _STATS: np.ascontiguousarray(encoded.stats, dtype="<f8").tobytes(),
    }
    sink = pa.BufferOutputStream()
    table = encoded.table.replace_schema_metadata(metadata)
    with pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue()


def from_buffer(buffer: pa.Buffer) -> EncodedEpisode:
    """The inverse of `to_bytes`, without a copy of the columns.

    Raises:
        DataError: the content is not such a file.
    """
    try:
        table = pa.ipc.open_file(buffer).read_all()
        metadata = table.schema.metadata or {}
        facts = json.loads(metadata[_FACTS])
        matrix = np.frombuffer(metadata[_STATS], dtype="<f8").reshape(len(stats.ROWS), -1)
    except (pa.ArrowException, KeyError, ValueError) as error:
        raise DataError(f"not a sealed episode: {error}") from error
    return EncodedEpisode(table.replace_schema_metadata(None), facts, matrix)


def with_index(
    encoded: EncodedEpisode, episode_index: int, first_frame: int, task_index: int
) -> tuple[pa.Table, stats.Matrix]:
    """The rows of a data file, and their statistics (R, D), at a place in a dataset."""
    frames = np.arange(len(encoded), dtype=np.int64)
    columns: dict[str, NDArray[np.generic]] = {
        "timestamp": (frames / spec.PLANNER_HZ).astype(np.float32),
        "frame_index": frames,
        "episode_index": np.full_like(frames, episode_index),
        "index": frames + first_frame,
        "task_index": np.full_like(frames, task_index),
    }
    ordered = schema.arrow_schema()
    own = dict(zip(encoded.table.column_names, encoded.table.columns, strict=True))
    arrays = own | {key: pa.array(values) for key, values in columns.items()}
    table = pa.Table.from_arrays([arrays[field.name] for field in ordered], schema=ordered)
    return table, np.concatenate([encoded.stats, stats.index_stats(columns)], axis=1)


def _arrow(values: NDArray[np.generic]) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
