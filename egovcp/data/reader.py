"""Reads a dataset straight from parquet: by episode, by column, or as arrays [Batch, Time, Data].

load_arrays("data/ball")["action"]         # (B, T, 7); or a Hub id: "me/egovcp-ball"
for episode in open_dataset("data/ball"):  # read on demand
    episode.depth                          # (T, 48, 64) uint16, mm
"""

from __future__ import annotations

import hashlib
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import metadata, schema
from egovcp.data.episode import Episode
from egovcp.data.parquet import (
    EPISODE_FEATURES,
    Columns,
    data_errors,
    open_data_file,
    present_columns,
    read_columns,
)
from egovcp.data.paths import require_file
from egovcp.data.provenance import ScenarioKey, ScenarioKeys, parse_provenance
from egovcp.data.source import Source, locate, locate_on_demand, select_episodes
from egovcp.dataset_options import DatasetConfig, SelectedDatasetConfig
from egovcp.errors import DataError, suggest
from egovcp.hub import HubFileCache, RetryPolicy, is_local_path

_OPEN_FILES = 8
_RETRY_POLICY = RetryPolicy()
_TIMESTAMP_TOLERANCE_S = 1e-3  # timestamps are float32


class DatasetReader:
    """A dataset with a validated `meta` folder; arrays are read, and checked, on demand."""

    def __init__(
        self, source: Source, cache: HubFileCache | None = None, episodes: str = ""
    ) -> None:
        """Read and check the `meta` folder. `open` also checks that the data files exist.

        Args:
            cache: downloads the data files when they are read; None: they are in the folder.
            episodes: the selected episodes (see `select_episodes`).
        """
        self.source = source
        self.root = source.root
        """Folder of the dataset."""
        self.info: Mapping[str, Any] = metadata.load_info(source.root)
        """``meta/info.json``."""
        self.robot = metadata.load_robot(self.info, source.root / schema.INFO_PATH)
        """The robot of the episodes."""
        self._table = metadata.load_episode_table(source.root, self.info)
        self.lengths = self._table.length
        """(E,) frames of each episode."""
        self._collection = metadata.load_collection(source.root, self.lengths)
        self.records: list[Mapping[str, Any]] = self._collection["episodes"]
        """Record of each episode in ``meta/collection.json``."""
        self.origin = parse_provenance(self._collection, source.root / schema.COLLECTION_PATH)
        """How the dataset was collected."""
        try:
            self._scenarios = ScenarioKeys(self.origin)
        except DataError as error:
            raise DataError.at(source.root / schema.COLLECTION_PATH, error.problem) from error
        self.task_names: Mapping[int, str] = metadata.load_tasks(source.root)
        """``meta/tasks.parquet``: task index -> task."""
        self._file_start = _file_starts(self._table)
        self._cache = cache
        self.episodes = episodes
        """The selected episodes, in the notation of `select_episodes`; empty: all."""
        self.selected = select_episodes(episodes, len(self))
        """Numbers of the selected episodes, ascending."""
        self._open_file = lru_cache(maxsize=_OPEN_FILES)(self._opened)
        # Batches are prefetched in a thread, and a parquet file is not thread-safe.
        self._lock = Lock()

    @classmethod
    def open(cls, config: DatasetConfig) -> Self:
        """Open the dataset that ``config`` names, from disk or from the Hub (see `locate`).

        Raises as `locate`, and `DataError` if it is damaged.
        """
        return cls.open_source(locate(config), episodes=_selection(config))

    @classmethod
    def open_source(
        cls, source: Source, cache: HubFileCache | None = None, episodes: str = ""
    ) -> Self:
        """Open a dataset that `locate` or `locate_on_demand` found.

        One on disk is opened again if a collector replaces it by its next version while it is read.
        For ``cache`` and ``episodes`` see the constructor.
        """
        if cache is not None:
            return cls(source, cache, episodes)
        while True:
            version = os.stat(source.root).st_ino
            try:
                reader = cls(source, episodes=episodes)
            except DataError:
                if os.stat(source.root).st_ino == version:
                    raise
            else:
                if os.stat(source.root).st_ino == version:
                    break
        for path in reader.frames_per_file:
            require_file(reader.root, path)
        return reader

    @classmethod
    def on_demand(cls, config: DatasetConfig, retry: RetryPolicy = _RETRY_POLICY) -> Self:
        """As `open`, but files on the Hub are downloaded when they are read, at the commit to which
        the revision resolves now."""
        return cls.open_source(*locate_on_demand(config, retry), _selection(config))

    def __len__(self) -> int:
        return len(self.lengths)

    def __iter__(self) -> Iterator[Episode]:
        """The episodes in order, each read on demand (see `read`)."""
        return (self.read(index) for index in range(len(self)))

    @property
    def is_remote(self) -> bool:
        """Whether data files are downloaded from the Hub when they are read."""
        return self._cache is not None

    @property
    def num_frames(self) -> int:
        """Frames of all episodes."""
        return int(self.lengths.sum())

    @property
    def frames_per_file(self) -> dict[Path, int]:
        """The data files, in order, and the number of frames in each."""
        frames: Counter[Path] = Counter()
        for index, length in enumerate(self.lengths.tolist()):
            frames[self.data_path(index)] += length
        return dict(frames)

    @property
    def fps(self) -> int:
        """Rows per second."""
        return int(self.info["fps"])

    @property
    def features(self) -> tuple[str, ...]:
        """The keys of `schema.FEATURES` that the dataset has."""
        return tuple(key for key in schema.FEATURES if key in self.info["features"])

    @property
    def controller_id(self) -> str:
        """Low-level controller that executed the actions."""
        return self.origin.controller_id

    @property
    def provenance(self) -> Mapping[str, Any]:
        """``meta/collection.json`` without its episodes: `origin` and entries of other tools."""
        return {key: value for key, value in self._collection.items() if key != "episodes"}

    @property
    def stats(self) -> dict[str, Any]:
        """Statistics of every feature, as in ``meta/stats.json``."""
        return metadata.load_stats(self.root)

    @property
    def content_digest(self) -> str:
        """Hash of identity, length and digest of the selected episodes, in order: equal for
        copies of a dataset."""
        facts = (f"{self.identity(i)} {self.lengths[i]} {self.digest(i)}" for i in self.selected)
        return hashlib.sha256("\n".join(facts).encode()).hexdigest()

    def task(self, index: int) -> str:
        return str(self.records[index]["task"])

    def metadata(self, index: int) -> Mapping[str, Any]:
        """Scenario seed and parameters of an episode."""
        found: Mapping[str, Any] = self.records[index].get("metadata", {})
        return found

    def time_limit(self, index: int) -> int:
        """Planned length of an episode, ticks."""
        return int(self.records[index]["time_limit"])

    def digest(self, index: int) -> str:
        """Recorded `Episode.digest` of an episode; empty if not recorded."""
        return str(self.records[index].get("sha256", ""))

    def identity(self, index: int) -> str:
        """Task, seed and episode number, the same in every dataset that holds the episode."""
        facts = self.metadata(index)
        seed, number = facts.get("seed", self._collection.get("seed")), facts.get("episode", index)
        return f"{self.task(index)}/{seed}/{number}"

    def scenario(self, index: int) -> ScenarioKey | None:
        """Key of the simulated scenario, distinct between configurations; None if not recorded."""
        try:
            return self._scenarios.key(self.task(index), self.metadata(index))
        except DataError as error:
            raise DataError.at(self.root / schema.COLLECTION_PATH, error.problem, index) from error

    def data_path(self, index: int) -> Path:
        return self.root / self._name(index)

    def read(self, index: int) -> Episode:
        """Read one episode; raises the first of its problems (see `inspect`)."""
        episode, problems = self.inspect(index)
        for error in problems:
            raise error
        assert episode is not None
        return episode

    def inspect(self, index: int) -> tuple[Episode | None, list[DataError]]:
        """Read one episode, and all its problems; the episode is None if it cannot be read."""
        path = self.data_path(index)
        try:
            columns = self.read_episode_columns(index, tuple(schema.FEATURES))
        except DataError as error:
            return None, [error]
        episode = self.to_episode(index, columns)
        found = [*self._index_problems(index, columns), *episode.problems()]
        if not found and self.digest(index) not in ("", episode.digest()):
            problem = "differs from what was collected: its sha256 is not the recorded one"
            found = [(None, problem)]
        return episode, [DataError.at(path, problem, index, frame) for frame, problem in found]

    def to_episode(self, index: int, columns: Columns) -> Episode:
        """The episode whose arrays are in ``columns``, not validated."""
        return Episode(
            **{name: columns[key] for name, key in EPISODE_FEATURES.items()},
            task=self.task(index),
            time_limit=self.time_limit(index),
            metadata=self.metadata(index),
            robot=self.robot,
        )

    def read_columns(self, names: Sequence[str]) -> Columns:
        """Whole columns over all frames, ``(N, ...)``; ``names`` are keys of `schema.FEATURES`."""
        parts = [self.read_episode_columns(i, names) for i in range(len(self))]
        return {name: np.concatenate([part[name] for part in parts]) for name in names}

    def read_episode_columns(self, index: int, names: Sequence[str]) -> Columns:
        """Some columns of one episode, ``(T, ...)`` each, not validated.

        Optional columns that the dataset lacks are zeros.
        """
        for name in names:
            if name not in schema.FEATURES:
                raise DataError(f"no column {name!r}{suggest(name, schema.FEATURES)}")
        if not 0 <= index < len(self):
            raise IndexError(f"episode {index} of {len(self)}")
        path = self.data_path(index)
        try:
            with data_errors(path):
                table = self._rows(path, index, names)
                if table.num_rows != self.lengths[index]:
                    raise DataError("ends before the end of the episode")
                return read_columns(table, names, self.robot)
        except DataError as error:
            raise DataError.at(path, error.problem or str(error), index, error.frame) from error

    def download(self, index: int) -> None:
        """Download the file of an episode unless it is on disk; see `HubFileCache.get`."""
        if self._cache is not None:
            self._cache.get(self._name(index))

    def prefetch(self, indices: Sequence[int]) -> None:
        """Start to download the files of these episodes; see `HubFileCache.prefetch`."""
        if self._cache is not None:
            self._cache.prefetch(map(self._name, indices))

    def episode_stats(self, feature: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean and standard deviation of a feature in each episode, (E, n) each, if recorded."""
        return metadata.load_episode_stats(self.root, feature, len(self))

    def _name(self, index: int) -> str:
        return str(self.info["data_path"]).format(
            chunk_index=int(self._table.chunk_index[index]),
            file_index=int(self._table.file_index[index]),
        )

    def _opened(self, path: Path) -> tuple[pq.ParquetFile, NDArray[np.int64]]:
        """A data file, and the rows (groups + 1,) at which its row groups begin and end."""
        if self._cache is not None:
            self._cache.get(path.relative_to(self.root).as_posix())
        file = open_data_file(self.root, path, self.robot)
        content = file.metadata
        groups = [content.row_group(g).num_rows for g in range(content.num_row_groups)]
        return file, np.cumsum([0, *groups])

    def _rows(self, path: Path, index: int, names: Sequence[str]) -> pa.Table:
        """The rows of an episode, from the row groups that hold them."""
        # The file names of depth frames are not read.
        names = present_columns(names, self.features)
        columns = [f"{name}.bytes" if name == spec.DEPTH_KEY else name for name in names]
        first = int(self._table.start[index] - self._file_start[index])
        last = first + int(self.lengths[index])
        with self._lock:
            file, edges = self._open_file(path)
            touched = np.flatnonzero((edges[:-1] < last) & (edges[1:] > first))
            table = file.read_row_groups(touched.tolist(), columns=columns, use_threads=False)
        offset = first - int(edges[touched[0]]) if len(touched) else 0
        return table.slice(offset, last - first)

    def _index_problems(self, index: int, columns: Columns) -> Iterator[tuple[int | None, str]]:
        frames = np.arange(len(columns["index"]))
        counts = {
            "index": frames + self._table.start[index],
            "frame_index": frames,
            "episode_index": np.full(len(frames), index),
        }
        for name, expected in counts.items():
            wrong = np.flatnonzero(columns[name] != expected)
            if len(wrong):
                at = int(wrong[0])
                found = columns[name][at]
                yield at, f"column {name} is {found}, expected {expected[at]}"
        wrong_time = mistimed(columns["timestamp"], self.fps)
        if wrong_time.any():
            at = int(np.argmax(wrong_time))
            found = columns["timestamp"][at]
            yield at, f"timestamp {found:g} s, expected {at / self.fps:g} at {self.fps} fps"
        own = [number for number, name in self.task_names.items() if name == self.task(index)]
        other = ~np.isin(columns["task_index"], own)
        if other.any():
            at = int(np.argmax(other))
            found = self.task_names.get(int(columns["task_index"][at]), "unknown")
            yield at, f"its task is {found}, but {schema.COLLECTION_PATH} says {self.task(index)}"


def mistimed(timestamp: NDArray[np.floating], fps: float) -> NDArray[np.bool_]:
    """(T,) whether the timestamp of frame t, s, differs from t / fps, or is NaN."""
    late = np.abs(timestamp - np.arange(len(timestamp)) / fps)
    return np.asarray(~(late <= _TIMESTAMP_TOLERANCE_S))


def _selection(config: DatasetConfig) -> str:
    return config.episodes if isinstance(config, SelectedDatasetConfig) else ""


def _file_starts(table: metadata.EpisodeTable) -> NDArray[np.int64]:
    """(E,) global index of the first frame in the file that holds each episode."""
    files = np.stack([table.chunk_index, table.file_index], axis=1)
    _, first_episode, file_of = np.unique(files, axis=0, return_index=True, return_inverse=True)
    return np.asarray(table.start[first_episode][file_of])


def open_dataset(where: str | Path, revision: str = "") -> DatasetReader:
    """Open a folder, or ``user/name`` on the Hub at a branch, tag or commit SHA (see `locate`)."""
    if not isinstance(where, str) or is_local_path(where):
        return DatasetReader.open(DatasetConfig(root=str(where), revision=revision))
    return DatasetReader.open(DatasetConfig(repo_id=str(where), revision=revision))


def load_arrays(
    dataset: str | Path | DatasetReader, columns: Sequence[str] = tuple(spec.FEATURES)
) -> dict[str, NDArray[Any]]:
    """Whole columns of a dataset of B episodes as (B, T, ...), T the longest episode's frames.

    ``columns`` are keys of ``schema.FEATURES``; by default all but indices and times. Frames after
    the end of an episode are zeros, and False in the additional array ``valid`` (B, T). Depth takes
    6 kB per frame: omit it from ``columns`` if it is not needed.
    """
    reader = dataset if isinstance(dataset, DatasetReader) else open_dataset(dataset)
    longest = int(reader.lengths.max())
    out: dict[str, NDArray[Any]] = {"valid": np.arange(longest) < reader.lengths[:, None]}
    for index, length in enumerate(reader.lengths):
        for name, values in reader.read_episode_columns(index, columns).items():
            if name not in out:
                shape = (len(reader), longest, *values.shape[1:])
                out[name] = np.zeros(shape, dtype=values.dtype)
            out[name][index, :length] = values
    return out
