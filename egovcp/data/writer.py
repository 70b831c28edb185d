"""Writes LeRobot v3.0 datasets.

`DatasetWriter` writes one in one go; `VersionWriter` writes the next version of a growing one.
A published folder never changes; it is replaced by its next version, which shares the files of
complete shards with the one before (hard links) and adds new shards and a new ``meta``. Its content
depends on its episodes and provenance alone, not on the number of versions before it. A shard is
one data file and its part of the episodes table. A collection that must survive a crash uses
`egovcp.data.committer`.
"""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import IO, Any, Final, Self

import pyarrow as pa
import pyarrow.parquet as pq

from egovcp import spec
from egovcp.data import dataset_files, schema, stats
from egovcp.data.destination import is_vacant, make_parent, require_new, resolve_root, writer_lock
from egovcp.data.episode import Episode
from egovcp.data.provenance import Provenance
from egovcp.data.staging import EncodedEpisode, encode, with_index
from egovcp.errors import DataError, EnvironmentFailure, UsageError
from egovcp.files import removed_on_error, sha256
from egovcp.robot_spec import G1, ROBOT_KEY, RobotSpec

#: A file system or kernel that cannot exchange two folders.
_NO_EXCHANGE: Final = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)
#: A mount point, or a folder of a lower layer of an overlay file system (a container's image).
_NO_RENAME: Final = (errno.EBUSY, errno.EXDEV)
_OCCUPIED: Final = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)


def shard_paths(number: int) -> tuple[str, str]:
    """Relative paths of a shard's data file and of its file of the episodes table."""
    place = _place(number)
    return schema.DATA_PATH.format(**place), schema.EPISODES_PATH.format(**place)


def _place(number: int) -> dict[str, int]:
    chunk, file = divmod(number, schema.CHUNK_FILES)
    return {"chunk_index": chunk, "file_index": file}


class ShardWriter:
    """Writes the files of shard ``number``, one row group per episode.

    Both files are complete and flushed after `close`.
    """

    def __init__(self, folder: Path, number: int, robot: RobotSpec) -> None:
        self._folder = folder
        self._robot = robot
        self._place = _place(number)
        self._data_path, self._episodes_path = shard_paths(number)
        self._file: IO[bytes] = dataset_files.open_new(folder / self._data_path)
        # A dictionary does not compress depth; snappy halves it at little cost.
        self._writer = pq.ParquetWriter(
            self._file, schema.arrow_schema(robot), compression="snappy", use_dictionary=False
        )
        self._rows: list[dict[str, Any]] = []
        self._stats: list[stats.Matrix] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(
        self, encoded: EncodedEpisode, episode_index: int, first_frame: int, task_index: int
    ) -> None:
        """Append an episode at its position in the dataset."""
        table, matrix = with_index(encoded, episode_index, first_frame, task_index)
        self._writer.write_table(table, row_group_size=table.num_rows)
        self._rows.append(
            {
                "episode_index": episode_index,
                "tasks": [encoded.record["task"]],
                "length": len(encoded),
                **{f"data/{name}": value for name, value in self._place.items()},
                "dataset_from_index": first_frame,
                "dataset_to_index": first_frame + len(encoded),
            }
        )
        self._stats.append(matrix)

    def close(self) -> tuple[stats.Matrix, int]:
        """Complete both files; returns the statistics and the number of all frames."""
        self._writer.close()
        self._file.close()
        counts = [row["length"] for row in self._rows]
        table = pa.Table.from_pylist(self._rows)
        columns = stats.to_arrow(self._stats, counts, self._robot)
        for name, value in self._place.items():
            columns[f"meta/episodes/{name}"] = pa.array([value] * len(counts))
        for name, column in columns.items():
            table = table.append_column(name, column)
        with dataset_files.open_new(self._folder / self._episodes_path) as file:
            pq.write_table(table, file)
        for path in (self._data_path, self._episodes_path):
            dataset_files.sync(self._folder / path)
        return stats.aggregate(self._stats, counts), sum(counts)

    def discard(self) -> None:
        with suppress(OSError, pa.ArrowException):
            self._writer.close()
        with suppress(OSError):
            self._file.close()


@dataclass(frozen=True)
class VersionContents:
    """Content of complete shards, from which the next version is built."""

    shard_episodes: int = schema.SHARD_EPISODES
    """Episodes per shard."""
    records: Sequence[str] = ()
    """The JSON record of each episode in ``meta/collection.json``."""
    tasks: Mapping[str, int] = field(default_factory=dict)
    """Task -> task index, in order of appearance."""
    totals: Sequence[tuple[stats.Matrix, int]] = ()
    """Statistics and number of frames of each shard."""
    hashes: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of each file of a shard."""
    robot: RobotSpec | None = None
    """The robot of all episodes; None: that of the first that is added."""

    @property
    def frames(self) -> int:
        return sum(count for _, count in self.totals)


class VersionWriter:
    """Writes the next version to a new folder: `add` episodes, then `close`."""

    def __init__(
        self,
        folder: Path,
        provenance: Provenance,
        contents: VersionContents | None = None,
        previous: Path | None = None,
    ) -> None:
        """Create ``folder`` with the complete shards, ``contents``, of the previous version, which
        is on the same file system."""
        self.folder = folder
        self.provenance = provenance
        self._complete = contents or VersionContents()
        self.frames = self._complete.frames
        """Number of frames so far."""
        self._records = list(self._complete.records)
        self._tasks = dict(self._complete.tasks)
        self._totals = list(self._complete.totals)
        self._hashes = dict(self._complete.hashes)
        self._shard: ShardWriter | None = None
        self._robot = self._complete.robot
        folder.mkdir(parents=True)
        if previous is not None:
            with removed_on_error(folder):
                self._link_files(previous)

    def _link_files(self, previous: Path) -> None:
        """Link the files of the shards, and other files beside ``data`` and ``meta``: a card."""
        for name in self._hashes:
            dataset_files.link(previous / name, self.folder / name)
        for path in previous.iterdir():
            if path.is_file():
                dataset_files.link(path, self.folder / path.name)
            elif path.name not in ("data", "meta"):
                shutil.copytree(path, self.folder / path.name)
                dataset_files.sync_tree(self.folder / path.name)

    @property
    def episodes(self) -> int:
        return len(self._records)

    def add(self, encoded: EncodedEpisode) -> None:
        """Append an episode.

        Raises:
            DataError: it is of another robot than the first.
        """
        self._robot = self._robot or encoded.robot
        if encoded.robot != self._robot:
            raise DataError(
                f"an episode of robot {encoded.robot.robot_type} cannot be added to a dataset of "
                f"robot {self._robot.robot_type}, or its names and sizes differ; write it to "
                "another dataset"
            )
        record = json.dumps(dict(encoded.record), allow_nan=False)
        task = self._tasks.setdefault(encoded.record["task"], len(self._tasks))
        if self._shard is None:
            self._shard = ShardWriter(self.folder, len(self._totals), self._robot)
        self._shard.add(encoded, self.episodes, self.frames, task)
        self._records.append(record)
        self.frames += len(encoded)
        if len(self._shard) == self._complete.shard_episodes:
            self._complete = self._close_shard(self._shard)

    def _close_shard(self, shard: ShardWriter) -> VersionContents:
        """Close the current shard; returns the content with it."""
        paths = shard_paths(len(self._totals))
        self._totals.append(shard.close())
        self._shard = None
        self._hashes |= {path: sha256(self.folder / path) for path in paths}
        return replace(
            self._complete,
            records=tuple(self._records),
            tasks=dict(self._tasks),
            totals=tuple(self._totals),
            hashes=dict(self._hashes),
            robot=self._robot,
        )

    def close(self) -> VersionContents:
        """Write ``meta`` and flush everything; returns the content of the complete shards."""
        if self._shard is not None:
            self._close_shard(self._shard)
        matrices, counts = zip(*self._totals, strict=True)
        total = stats.to_json(stats.aggregate(matrices, counts), self.frames, self._robot or G1)
        self._write_tasks()
        dataset_files.create_json(self.folder / schema.INFO_PATH, self._info())
        dataset_files.create_json(self.folder / schema.STATS_PATH, total)
        dataset_files.create_file(self.folder / schema.COLLECTION_PATH, self._collection())
        meta = (schema.INFO_PATH, schema.STATS_PATH, schema.TASKS_PATH, schema.COLLECTION_PATH)
        hashes = self._hashes | {path: sha256(self.folder / path) for path in meta}
        dataset_files.create_json(self.folder / schema.HASHES_PATH, hashes)
        for path in (*(self.folder / "meta").glob("*.*"), *self.folder.rglob("*/"), self.folder):
            dataset_files.sync(path)
        return self._complete

    def discard(self) -> None:
        if self._shard is not None:
            self._shard.discard()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _write_tasks(self) -> None:
        import pandas as pd  # LeRobot reads the task names from a pandas index

        names = pd.Index(list(self._tasks), name="task")
        frame = pd.DataFrame({"task_index": list(self._tasks.values())}, index=names)
        with dataset_files.open_new(self.folder / schema.TASKS_PATH) as file:
            frame.to_parquet(file)

    def _info(self) -> dict[str, Any]:
        robot = self._robot or G1
        return {
            "codebase_version": schema.CODEBASE_VERSION,
            "fps": robot.planner_hz,
            "features": schema.info_features(self.provenance.controller_id, robot),
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": len(self._tasks),
            "chunks_size": schema.CHUNK_FILES,
            "data_files_size_in_mb": schema.FILE_MB,
            "video_files_size_in_mb": 200,
            "data_path": schema.DATA_PATH,
            "video_path": None,
            "robot_type": robot.robot_type,
            "splits": {"train": f"0:{self.episodes}"},
            **({} if robot.is_g1 else {ROBOT_KEY: robot.to_json()}),
        }

    def _collection(self) -> bytes:
        """``meta/collection.json``, one line per episode."""
        head = {
            "collection_version": schema.COLLECTION_VERSION,
            "spec_version": spec.SPEC_VERSION,
            **asdict(self.provenance),
            "shard_episodes": self._complete.shard_episodes,
        }
        text = json.dumps(head, indent=1, allow_nan=False).removesuffix("\n}")
        records = ",\n  ".join(self._records)
        return f'{text},\n "episodes": [\n  {records}\n ]\n}}\n'.encode()


def publish_version(folder: Path, root: Path, replace: bool = False) -> None:
    """Make the complete version ``folder`` the dataset at ``root``, atomically.

    If ``replace``, ``root`` is the previous version, which is moved to ``folder``. Otherwise
    ``root`` must be absent or an empty folder.
    """
    try:
        if replace:
            _exchange(folder, root)
        else:
            dataset_files.rename(folder, root)  # replaces an empty folder only
    except OSError as error:
        if error.errno in _OCCUPIED:
            raise UsageError(
                f"output folder {root} is no longer empty: another program has written to it"
            ) from error
        if error.errno in _NO_RENAME:
            raise EnvironmentFailure(
                f"{root} cannot be renamed ({error.strerror}): it is a mount point, or part of a "
                "container image; copy it to a folder inside a volume and use that"
            ) from error
        raise
    dataset_files.sync(root.parent)


@contextmanager
def new_dataset(root: Path) -> Iterator[Path]:
    """A folder that becomes the new dataset ``root`` at the end of the block, unless it raises."""
    work = root.with_name(f".{root.name}.new")
    work.mkdir(parents=True, exist_ok=True)
    folder = work / "dataset"
    with writer_lock(root, work):
        shutil.rmtree(folder, ignore_errors=True)  # of a killed command
        try:
            yield folder
            dataset_files.sync_tree(folder)
            publish_version(folder, root)
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _exchange(folder: Path, root: Path) -> None:
    try:
        dataset_files.exchange(folder, root)
    except OSError as error:
        if error.errno not in _NO_EXCHANGE:
            raise
        aside = aside_folder(folder)  # `recover` completes the three renames after a crash
        dataset_files.rename(root, aside)
        try:
            dataset_files.rename(folder, root)
        except OSError:
            dataset_files.rename(aside, root)
            raise
        dataset_files.rename(aside, folder)


def recover(folder: Path, root: Path) -> None:
    """Restore the version that a crash within `publish_version` left aside."""
    aside = aside_folder(folder)
    if aside.exists():
        if is_vacant(root):
            dataset_files.rename(aside, root)
        else:
            shutil.rmtree(aside)


def aside_folder(folder: Path) -> Path:
    """Where `publish_version` keeps the previous version between two renames."""
    return folder.with_name(f"{folder.name}.before")


class DatasetWriter:
    """Context manager that adds episodes one by one to the new dataset ``root`` (`new_dataset`).

    On an error in the block nothing is left.
    """

    def __init__(
        self, root: str | Path, provenance: Provenance, shard_episodes: int = schema.SHARD_EPISODES
    ) -> None:
        """``root`` must be absent or an empty folder."""
        self.root = resolve_root(root)
        require_new(self.root)
        make_parent(self.root)
        self._provenance, self._contents = provenance, VersionContents(shard_episodes)

    @property
    def num_episodes(self) -> int:
        return self._version.episodes

    @property
    def num_frames(self) -> int:
        return self._version.frames

    def add(self, episode: Episode) -> None:
        """Validate and append a complete episode (see `Episode.validate`)."""
        self._version.add(encode(episode, f"episode {self.num_episodes}"))

    def __enter__(self) -> Self:
        self._block = self._new_version()
        self._version = self._block.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._block.__exit__(*error)

    @contextmanager
    def _new_version(self) -> Iterator[VersionWriter]:
        with new_dataset(self.root) as folder:
            version = VersionWriter(folder, self._provenance, self._contents)
            try:
                yield version
                if not version.episodes:
                    raise UsageError(f"no episode was written to {self.root}")
                version.close()
            except BaseException:
                version.discard()
                raise
