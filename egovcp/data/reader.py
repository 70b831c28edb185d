"""Reads a dataset episode by episode, or column by column, straight from parquet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from egovcp import spec
from egovcp.cli import DatasetConfig
from egovcp.data import metadata, schema, tiff
from egovcp.data.episode import Episode
from egovcp.data.source import Source, locate
from egovcp.errors import DataError, suggest

_OPEN_FILES = 8
_TIMESTAMP_SLACK = 1e-3  # s; float32 timestamps

type Columns = dict[str, NDArray[Any]]


class DatasetReader:
    """A validated dataset; the arrays themselves are read, and checked, on demand."""

    def __init__(self, source: Source) -> None:
        """Check the `meta` folder of a dataset that lies on disk.

        Raises:
            DataError: it is damaged, incomplete, or of another specification.
        """
        self.source = source
        self._info = metadata.load_info(source.root)
        self._table = metadata.load_episode_table(source.root, self._info)
        self._collection = metadata.load_collection(source.root, len(self))
        self._task_names = metadata.load_tasks(source.root)
        self._file_start = _file_starts(self._table)
        self._open_file = lru_cache(maxsize=_OPEN_FILES)(_open_parquet)

    @classmethod
    def open(cls, config: DatasetConfig) -> Self:
        """Open the dataset that ``config`` names, from disk or from the Hub.

        The network is never touched when a root is given or LeRobot's local folder has
        the dataset and no revision is asked for.

        Raises:
            UsageError: the configuration names no dataset.
            DataError: there is none, or not one of this specification.
            EnvironmentFailure: the Hub cannot be reached.
        """
        return cls(locate(config))

    def __len__(self) -> int:
        return len(self._table.length)

    @property
    def root(self) -> Path:
        """Folder of the dataset."""
        return self.source.root

    @property
    def lengths(self) -> NDArray[np.int64]:
        """(E,) frames of each episode."""
        return self._table.length

    @property
    def num_frames(self) -> int:
        """Frames of all episodes."""
        return int(self._table.length.sum())

    @property
    def fps(self) -> int:
        """Rows per second."""
        return int(self._info["fps"])

    @property
    def controller_id(self) -> str:
        """Low-level controller that the actions were given to."""
        return str(self._collection["controller_id"])

    @property
    def provenance(self) -> Mapping[str, Any]:
        """How the dataset was collected: command, seed, versions, configuration."""
        return {key: value for key, value in self._collection.items() if key != "episodes"}

    @property
    def stats(self) -> dict[str, Any]:
        """Statistics of every feature, as in ``meta/stats.json``."""
        return metadata.load_object(self.root / schema.STATS_PATH)

    def task(self, index: int) -> str:
        """Task of an episode."""
        return str(self._collection["episodes"][index]["task"])

    def metadata(self, index: int) -> Mapping[str, Any]:
        """Scenario seed and parameters of an episode."""
        found: Mapping[str, Any] = self._collection["episodes"][index].get("metadata", {})
        return found

    def time_limit(self, index: int) -> int:
        """Planned length of an episode, ticks."""
        return int(self._collection["episodes"][index]["time_limit"])

    def identity(self, index: int) -> str:
        """What the episode is, whatever dataset holds it: task, seed and episode number."""
        facts = self.metadata(index)
        seed, number = facts.get("seed", self._collection.get("seed")), facts.get("episode", index)
        return f"{self.task(index)}/{seed}/{number}"

    def read(self, index: int) -> Episode:
        """Read one episode and validate it.

        Raises:
            DataError: the file is damaged or its content violates the specification.
            IndexError: there is no such episode.
        """
        where = f"{self.root}, episode {index}"
        columns = self._columns(index, tuple(schema.FEATURES))
        self._check_index(index, columns, where)
        episode = Episode(
            depth=columns[spec.DEPTH_KEY],
            state=columns[spec.STATE_KEY],
            action=columns[spec.ACTION_KEY],
            reward=columns[spec.REWARD_KEY],
            done=columns[spec.DONE_KEY],
            success=columns[spec.SUCCESS_KEY],
            truncated=columns[spec.TRUNCATED_KEY],
            task=self.task(index),
            time_limit=self.time_limit(index),
            metadata=self.metadata(index),
        )
        episode.validate(where)
        self._check_digest(index, episode)
        return episode

    def _check_digest(self, index: int, episode: Episode) -> None:
        """Compare with what was sealed; datasets of version 1 do not say."""
        sealed = self._collection["episodes"][index].get("sha256")
        if sealed is not None and sealed != episode.digest():
            raise DataError(
                f"{self._data_path(index)}, episode {index}: its SHA-256 is not the one of "
                f"{schema.COLLECTION_PATH}; the file has changed since it was written"
            )

    def read_columns(self, names: Sequence[str]) -> Columns:
        """Whole columns over all frames, ``(N, ...)`` each, in episode order.

        Args:
            names: LeRobot feature names, keys of ``schema.FEATURES``.
        """
        for name in names:
            if name not in schema.FEATURES:
                raise DataError(f"no column {name!r}{suggest(name, schema.FEATURES)}")
        parts = [self._columns(i, tuple(names)) for i in range(len(self))]
        return {name: np.concatenate([part[name] for part in parts]) for name in names}

    def _columns(self, index: int, names: Sequence[str]) -> Columns:
        if not 0 <= index < len(self):
            raise IndexError(f"episode {index} of {len(self)}")
        path = self._data_path(index)
        with metadata.damaged(path):
            table = self._rows(self._open_file(path), index, names)
            if table.num_rows != self._table.length[index]:
                raise DataError(f"{path} ends before the end of episode {index}")
            return {name: _to_numpy(table[name], name) for name in names}

    def _data_path(self, index: int) -> Path:
        name = str(self._info["data_path"]).format(
            chunk_index=int(self._table.chunk_index[index]),
            file_index=int(self._table.file_index[index]),
        )
        return self.root / name

    def _rows(self, file: pq.ParquetFile, index: int, names: Sequence[str]) -> pa.Table:
        """The rows of an episode, from the row groups that hold them."""
        groups = [file.metadata.row_group(g).num_rows for g in range(file.num_row_groups)]
        edges = np.concatenate([[0], np.cumsum(groups)])
        first = int(self._table.start[index] - self._file_start[index])
        last = first + int(self._table.length[index])
        touched = np.flatnonzero((edges[:-1] < last) & (edges[1:] > first))
        table = file.read_row_groups(touched.tolist(), columns=list(names), use_threads=False)
        offset = first - int(edges[touched[0]]) if len(touched) else 0
        return table.slice(offset, last - first)

    def _check_index(self, index: int, columns: Columns, where: str) -> None:
        frames = np.arange(len(columns["index"]))
        expected = {
            "index": frames + self._table.start[index],
            "frame_index": frames,
            "episode_index": np.full(len(frames), index),
        }
        for name, values in expected.items():
            if not np.array_equal(columns[name], values):
                raise DataError(f"{where}: column {name} does not count {values[0]}, ...")
        if np.abs(columns["timestamp"] - frames / self.fps).max() > _TIMESTAMP_SLACK:
            raise DataError(f"{where}: timestamps are not those of {self.fps} frames per second")
        names = {self._task_names.get(int(i), "unknown") for i in np.unique(columns["task_index"])}
        if names != {self.task(index)}:
            raise DataError(f"{where}: tasks {sorted(names)}, collection says {self.task(index)}")


def _file_starts(table: metadata.EpisodeTable) -> NDArray[np.int64]:
    """(E,) global index of the first frame in the file that holds each episode."""
    files = np.stack([table.chunk_index, table.file_index], axis=1)
    _, first_episode, file_of = np.unique(files, axis=0, return_index=True, return_inverse=True)
    return np.asarray(table.start[first_episode][file_of])


def _open_parquet(path: Path) -> pq.ParquetFile:
    return pq.ParquetFile(path, memory_map=True)


def _to_numpy(column: pa.ChunkedArray, name: str) -> NDArray[Any]:
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays(array.chunks)
    if array.null_count:
        raise DataError(f"column {name} has {array.null_count} empty rows")
    if name == spec.DEPTH_KEY:
        return tiff.decode(array.field("bytes"), spec.DEPTH_ROWS, spec.DEPTH_COLS)
    feature = schema.FEATURES[name]
    if schema.width(name) > 1:
        flat = array.flatten().to_numpy(zero_copy_only=False)
        return np.asarray(flat.reshape(len(array), -1), dtype=str(feature["dtype"]))
    return np.asarray(array.to_numpy(zero_copy_only=False), dtype=str(feature["dtype"]))
