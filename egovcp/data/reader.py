"""Reads a dataset episode by episode, or column by column, straight from parquet."""

from __future__ import annotations

import hashlib
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
from egovcp.cli import DatasetConfig, SelectedDatasetConfig
from egovcp.data import metadata, schema
from egovcp.data.columns import EPISODE_FEATURES, Columns, open_data_file, to_numpy
from egovcp.data.digests import Digests
from egovcp.data.episode import Episode
from egovcp.data.origin import ScenarioKey, ScenarioKeys
from egovcp.data.parquet import damaged
from egovcp.data.paths import require_file
from egovcp.data.provenance import parse_provenance
from egovcp.data.selection import select_episodes
from egovcp.data.source import Source, is_local, locate, shelve
from egovcp.errors import DataError, suggest
from egovcp.hub import RetryPolicy, Shelf

_OPEN_FILES = 8
_RETRY_POLICY = RetryPolicy()
_TIMESTAMP_SLACK = 1e-3  # s; float32 timestamps


class DatasetReader:
    """A validated dataset; the arrays themselves are read, and checked, on demand."""

    def __init__(self, source: Source, shelf: Shelf | None = None, episodes: str = "") -> None:
        """Check the `meta` folder of a dataset that lies on disk; `open` looks for its files, too.

        Args:
            source: where it lies.
            shelf: what brings its data files when they are read; None: they are there.
            episodes: those of them that are asked for (see `select_episodes`); empty: all.

        Raises:
            UsageError: the episodes asked for are not there.
            DataError: it is damaged, incomplete, or of another specification.
        """
        self.source = source
        self._info = metadata.load_info(source.root)
        self._table = metadata.load_episode_table(source.root, self._info)
        self._collection = metadata.load_collection(source.root, self.lengths)
        self.origin = parse_provenance(self._collection, source.root / schema.COLLECTION_PATH)
        """How the dataset was collected."""
        try:
            self._scenarios = ScenarioKeys(self.origin)
        except DataError as error:
            raise DataError.at(source.root / schema.COLLECTION_PATH, error.problem) from error
        self._task_names = metadata.load_tasks(source.root)
        self._file_start = _file_starts(self._table)
        self._shelf, self._episodes = shelf, episodes
        self.chosen = select_episodes(episodes, len(self))
        """The numbers of the episodes that are asked for, ascending."""
        self._open_file = lru_cache(maxsize=_OPEN_FILES)(self._opened)
        # A batch is made ahead in a thread; two that read one open file find it damaged.
        self._reading = Lock()

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
        reader = cls(locate(config), episodes=_asked_for(config))
        for path in reader.frames_per_file:
            require_file(reader.root, path)
        return reader

    @classmethod
    def on_demand(cls, config: DatasetConfig, retry: RetryPolicy = _RETRY_POLICY) -> Self:
        """Open a dataset to stream from: what is only on the Hub comes file by file, when it is
        read, at the commit that the revision is now.

        Raises:
            UsageError: the configuration names no dataset.
            DataError: there is none, or not one of this specification.
            EnvironmentFailure: the Hub cannot be reached.
        """
        if is_local(config):
            return cls.open(config)
        shelf = shelve(config, retry)
        source = Source(shelf.folder, shelf.repo_id, shelf.commit)
        return cls(source, shelf, _asked_for(config))

    def __len__(self) -> int:
        return len(self._table.length)

    def __iter__(self) -> Iterator[Episode]:
        """The episodes in order, each read when its turn comes (see `read`)."""
        return (self.read(index) for index in range(len(self)))

    @property
    def is_remote(self) -> bool:
        """Whether its data files come from the Hub as they are read."""
        return self._shelf is not None

    @property
    def episodes(self) -> str:
        """Which episodes were asked for, in the words of `select_episodes`; empty: all."""
        return self._episodes

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
    def frames_per_file(self) -> dict[Path, int]:
        """The data files, in order, and how many frames each holds."""
        frames: Counter[Path] = Counter()
        for index, length in enumerate(self.lengths.tolist()):
            frames[self.data_path(index)] += length
        return dict(frames)

    @property
    def fps(self) -> int:
        """Rows per second."""
        return int(self._info["fps"])

    @property
    def info(self) -> Mapping[str, Any]:
        """``meta/info.json``."""
        return self._info

    @property
    def task_names(self) -> Mapping[int, str]:
        """``meta/tasks.parquet``: task index -> task."""
        return self._task_names

    @property
    def controller_id(self) -> str:
        """Low-level controller that the actions were given to."""
        return self.origin.controller_id

    @property
    def provenance(self) -> Mapping[str, Any]:
        """`origin` as it is in ``meta/collection.json``, with entries that others added."""
        return {key: value for key, value in self._collection.items() if key != "episodes"}

    @property
    def stats(self) -> dict[str, Any]:
        """Statistics of every feature, as in ``meta/stats.json``."""
        return metadata.load_stats(self.root)

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

    def digest(self, index: int) -> str:
        """`Episode.digest` as it was when the episode was written; empty if not recorded."""
        return str(self._collection["episodes"][index].get("sha256", ""))

    @property
    def content_digest(self) -> str:
        """Hash of identity, length and recorded digest of the episodes that are asked for, in
        order: equal for copies of a dataset, wherever they lie."""
        facts = (f"{self.identity(i)} {self.lengths[i]} {self.digest(i)}" for i in self.chosen)
        return hashlib.sha256("\n".join(facts).encode()).hexdigest()

    def identity(self, index: int) -> str:
        """What the episode is, whatever dataset holds it: task, seed and episode number."""
        facts = self.metadata(index)
        seed, number = facts.get("seed", self._collection.get("seed")), facts.get("episode", index)
        return f"{self.task(index)}/{seed}/{number}"

    def scenario(self, index: int) -> ScenarioKey | None:
        """What an episode simulates, whatever dataset holds it; None if that is not recorded.

        Unlike `identity` it tells collections of different configurations apart.

        Raises:
            DataError: it names a collection that is not recorded.
        """
        try:
            return self._scenarios.key(self.task(index), self.metadata(index))
        except DataError as error:
            raise DataError.at(self.root / schema.COLLECTION_PATH, error.problem, index) from error

    def read(self, index: int, digests: Digests | None = None) -> Episode:
        """Read one episode, validate it and compare it with its recorded digest.

        Args:
            index: its number.
            digests: compares it while others are read, and raises what is wrong then; None: it is
                compared at once.

        Raises:
            DataError: the file is damaged or its content violates the specification.
            IndexError: there is no such episode.
        """
        episode, problems = self._examined(index) if digests is not None else self.inspect(index)
        for error in problems:
            raise error
        assert episode is not None
        if digests is not None:
            digests.compare(episode, self.digest(index), self._changed(index))
        return episode

    def inspect(self, index: int) -> tuple[Episode | None, list[DataError]]:
        """Read one episode, and everything that is wrong with it; None if it cannot be read.

        Raises:
            IndexError: there is no such episode.
        """
        episode, problems = self._examined(index)
        known = self.digest(index)
        if episode is not None and not problems and known not in ("", episode.digest()):
            problems = [self._changed(index)]
        return episode, problems

    def _examined(self, index: int) -> tuple[Episode | None, list[DataError]]:
        """As `inspect`, but for the digest."""
        path = self.data_path(index)
        try:
            columns = self._columns(index, tuple(schema.FEATURES))
        except DataError as error:
            return None, [error]
        episode = Episode(
            **{name: columns[key] for name, key in EPISODE_FEATURES.items()},
            task=self.task(index),
            time_limit=self.time_limit(index),
            metadata=self.metadata(index),
        )
        found = [*self._index_problems(index, columns), *episode.problems()]
        return episode, [DataError.at(path, problem, index, frame) for frame, problem in found]

    def _changed(self, index: int) -> DataError:
        return DataError.at(
            self.data_path(index),
            "differs from what was collected: its sha256 is not the recorded one",
            index,
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

    def read_episode_columns(self, index: int, names: Sequence[str]) -> Columns:
        """Some columns of one episode, ``(T, ...)`` each, not validated.

        Raises:
            DataError: the file is damaged.
            IndexError: there is no such episode.
        """
        return self._columns(index, names)

    def _columns(self, index: int, names: Sequence[str]) -> Columns:
        if not 0 <= index < len(self):
            raise IndexError(f"episode {index} of {len(self)}")
        path = self.data_path(index)
        try:
            with damaged(path):
                table = self._rows(path, index, names)
                if table.num_rows != self._table.length[index]:
                    raise DataError("ends before the end of the episode")
                return {name: to_numpy(table[name], name) for name in names}
        except DataError as error:
            raise DataError.at(path, error.problem or str(error), index, error.frame) from error

    def bring(self, index: int) -> None:
        """Have the file of an episode here, which may mean to wait for it.

        Raises:
            DataError: the dataset on the Hub lacks it.
            EnvironmentFailure: the Hub cannot be reached, or refuses.
        """
        if self._shelf is not None:
            self._shelf.bring(self._name(index))

    def expect(self, indices: Sequence[int]) -> None:
        """Say which episodes are read next, so that their files come meanwhile."""
        if self._shelf is not None:
            self._shelf.expect(map(self._name, indices))

    def episode_stats(self, feature: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean and deviation of a feature in each episode, (E, n) each, from `meta/episodes`.

        Raises:
            DataError: they are not there.
        """
        return metadata.load_episode_stats(self.root, feature, len(self))

    def _name(self, index: int) -> str:
        return str(self._info["data_path"]).format(
            chunk_index=int(self._table.chunk_index[index]),
            file_index=int(self._table.file_index[index]),
        )

    def _opened(self, path: Path) -> tuple[pq.ParquetFile, NDArray[np.int64]]:
        """A data file, and the rows (groups + 1,) at which its row groups begin and end."""
        if self._shelf is not None:
            self._shelf.bring(path.relative_to(self.root).as_posix())
        file = open_data_file(self.root, path)
        content = file.metadata
        groups = [content.row_group(g).num_rows for g in range(content.num_row_groups)]
        return file, np.cumsum([0, *groups])

    def data_path(self, index: int) -> Path:
        """The file that holds an episode."""
        return self.root / self._name(index)

    def _rows(self, path: Path, index: int, names: Sequence[str]) -> pa.Table:
        """The rows of an episode, from the row groups that hold them."""
        first = int(self._table.start[index] - self._file_start[index])
        last = first + int(self._table.length[index])
        with self._reading:
            file, edges = self._open_file(path)
            touched = np.flatnonzero((edges[:-1] < last) & (edges[1:] > first))
            table = file.read_row_groups(touched.tolist(), columns=_parts(names), use_threads=False)
        offset = first - int(edges[touched[0]]) if len(touched) else 0
        return table.slice(offset, last - first)

    def _index_problems(self, index: int, columns: Columns) -> Iterator[tuple[int, str]]:
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
                yield at, f"column {name} does not count: {found}, expected {expected[at]}"
        late = ~(np.abs(columns["timestamp"] - frames / self.fps) <= _TIMESTAMP_SLACK)
        if late.any():
            at = int(np.argmax(late))
            found = columns["timestamp"][at]
            yield at, f"timestamp {found:g} s, expected {at / self.fps:g} at {self.fps} fps"
        own = [number for number, name in self._task_names.items() if name == self.task(index)]
        other = ~np.isin(columns["task_index"], own)
        if other.any():
            at = int(np.argmax(other))
            found = self._task_names.get(int(columns["task_index"][at]), "unknown")
            yield at, f"its task is {found}, but {schema.COLLECTION_PATH} says {self.task(index)}"


def _asked_for(config: DatasetConfig) -> str:
    return config.episodes if isinstance(config, SelectedDatasetConfig) else ""


def _parts(names: Sequence[str]) -> list[str]:
    """The columns as parquet names them; a depth frame's file name is of no use here."""
    return [f"{name}.bytes" if name == spec.DEPTH_KEY else name for name in names]


def _file_starts(table: metadata.EpisodeTable) -> NDArray[np.int64]:
    """(E,) global index of the first frame in the file that holds each episode."""
    files = np.stack([table.chunk_index, table.file_index], axis=1)
    _, first_episode, file_of = np.unique(files, axis=0, return_index=True, return_inverse=True)
    return np.asarray(table.start[first_episode][file_of])
