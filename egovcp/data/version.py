"""A dataset folder never changes: it is replaced by its next version.

A version shares the files of its complete shards with the one before (hard links) and brings new
shards and a new ``meta``. Its content depends on its episodes and provenance alone, not on how many
versions came before it.
"""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from egovcp import spec
from egovcp.atomic import removed_on_error
from egovcp.data import files, schema, stats
from egovcp.data.destination import is_vacant
from egovcp.data.encoded import EncodedEpisode
from egovcp.data.provenance import Provenance
from egovcp.data.shard import Shard, shard_paths
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.safe_files import sha256

#: A file system or kernel that cannot exchange two folders.
_NO_EXCHANGE: Final = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)
#: A mount point, or a folder of a lower layer of an overlay file system (a container's image).
_NO_RENAME: Final = (errno.EBUSY, errno.EXDEV)
_OCCUPIED: Final = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)


@dataclass(frozen=True)
class Contents:
    """What a version holds, as far as the next one must know."""

    shard_episodes: int = schema.SHARD_EPISODES
    """Episodes per shard; only the last may hold fewer."""
    records: Sequence[str] = ()
    """The JSON record of each episode in ``meta/collection.json``."""
    frames: int = 0
    """Frames of all episodes."""
    tasks: Mapping[str, int] = field(default_factory=dict)
    """Task -> task index, in order of appearance."""
    totals: Sequence[tuple[stats.Matrix, int]] = ()
    """Statistics and number of frames of each shard."""
    hashes: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of each file of a shard."""

    def split(self, last: Sequence[EncodedEpisode]) -> tuple[Contents, list[EncodedEpisode]]:
        """The complete shards alone, and the episodes of the one that is not, the end of
        ``last``."""
        over = len(self.records) % self.shard_episodes
        if not over:
            return self, []
        tail = list(last[-over:])
        tasks = {json.loads(record)["task"] for record in self.records[:-over]}
        full = len(self.totals) - 1
        return Contents(
            self.shard_episodes,
            self.records[:-over],
            self.frames - sum(map(len, tail)),
            {task: index for task, index in self.tasks.items() if task in tasks},
            self.totals[:-1],
            {name: h for name, h in self.hashes.items() if name not in shard_paths(full)},
        ), tail


class Version:
    """Builds the next version in a new folder: `add` episodes, then `close`."""

    def __init__(
        self,
        folder: Path,
        provenance: Provenance,
        contents: Contents | None = None,
        previous: Path | None = None,
    ) -> None:
        """Begin.

        Args:
            folder: does not exist yet; on the file system of ``previous``.
            provenance: what ``meta/collection.json`` will say.
            contents: what ``previous`` holds, in complete shards.
            previous: the version before.
        """
        self.folder = folder
        self.provenance = provenance
        contents = contents or Contents()
        self.frames = contents.frames
        self._shard_episodes = contents.shard_episodes
        self._records = list(contents.records)
        self._tasks = dict(contents.tasks)
        self._totals = list(contents.totals)
        self._hashes = dict(contents.hashes)
        self._shard: Shard | None = None
        folder.mkdir(parents=True)
        if previous is not None:
            with removed_on_error(folder):
                self._take_over(previous)

    def _take_over(self, previous: Path) -> None:
        """The files of the shards, and what others put beside ``data`` and ``meta``: a card."""
        for name in self._hashes:
            files.link(previous / name, self.folder / name)
        for path in previous.iterdir():
            if path.is_file():
                files.link(path, self.folder / path.name)
            elif path.name not in ("data", "meta"):
                shutil.copytree(path, self.folder / path.name)

    @property
    def episodes(self) -> int:
        """Number of episodes so far."""
        return len(self._records)

    def add(self, encoded: EncodedEpisode) -> None:
        """Append an episode."""
        record = json.dumps(dict(encoded.facts), allow_nan=False)
        task = self._tasks.setdefault(encoded.facts["task"], len(self._tasks))
        if self._shard is None:
            self._shard = Shard(self.folder, len(self._totals))
        self._shard.add(encoded, self.episodes, self.frames, task)
        self._records.append(record)
        self.frames += len(encoded)
        if len(self._shard) == self._shard_episodes:
            self._close_shard()

    def _close_shard(self) -> None:
        if self._shard is not None:
            self._totals.append(self._shard.close())
            self._hashes.update(self._shard.hashes())
            self._shard = None

    def close(self) -> Contents:
        """Write ``meta`` and flush everything; what the version holds."""
        self._close_shard()
        self._write_meta()
        for path in (*(self.folder / "meta").glob("*.*"), *self.folder.rglob("*/"), self.folder):
            files.sync(path)
        return Contents(
            self._shard_episodes,
            self._records,
            self.frames,
            self._tasks,
            self._totals,
            self._hashes,
        )

    def _write_meta(self) -> None:
        matrices, counts = zip(*self._totals, strict=True)
        total = stats.to_json(stats.aggregate(matrices, counts), self.frames)
        self._write_tasks()
        files.write_json(self.folder / schema.INFO_PATH, self._info())
        files.write_json(self.folder / schema.STATS_PATH, total)
        files.write_bytes(self.folder / schema.COLLECTION_PATH, self._collection())
        files.write_json(self.folder / schema.HASHES_PATH, self._all_hashes())

    def discard(self) -> None:
        """Remove the folder."""
        if self._shard is not None:
            self._shard.abandon()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _write_tasks(self) -> None:
        import pandas as pd  # LeRobot reads the task names from a pandas index

        names = pd.Index(list(self._tasks), name="task")
        frame = pd.DataFrame({"task_index": list(self._tasks.values())}, index=names)
        with files.create(self.folder / schema.TASKS_PATH) as file:
            frame.to_parquet(file)

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": schema.CODEBASE_VERSION,
            "fps": spec.PLANNER_HZ,
            "features": schema.info_features(self.provenance.controller_id),
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": len(self._tasks),
            "chunks_size": schema.CHUNK_FILES,
            "data_files_size_in_mb": schema.FILE_MB,
            "video_files_size_in_mb": 200,
            "data_path": schema.DATA_PATH,
            "video_path": None,
            "robot_type": schema.ROBOT_TYPE,
            "splits": {"train": f"0:{self.episodes}"},
        }

    def _collection(self) -> bytes:
        """``meta/collection.json``, one line per episode."""
        head = {
            "collection_version": schema.COLLECTION_VERSION,
            "spec_version": spec.SPEC_VERSION,
            **asdict(self.provenance),
            "shard_episodes": self._shard_episodes,
        }
        text = json.dumps(head, indent=1, allow_nan=False).removesuffix("\n}")
        records = ",\n  ".join(self._records)
        return f'{text},\n "episodes": [\n  {records}\n ]\n}}\n'.encode()

    def _all_hashes(self) -> dict[str, str]:
        """Every file of the dataset but this list itself."""
        paths = (schema.INFO_PATH, schema.STATS_PATH, schema.TASKS_PATH, schema.COLLECTION_PATH)
        meta = {path: sha256(self.folder / path) for path in paths}
        return {**self._hashes, **meta}


def publish(folder: Path, root: Path, replace: bool = False) -> None:
    """Make the finished version ``folder`` the dataset at ``root``, in one step.

    Args:
        folder: the new version, on the file system of ``root``.
        root: the dataset.
        replace: whether ``root`` is the version before, which lies in ``folder`` afterwards, or is
            gone. Otherwise nothing may be there but an empty folder.

    Raises:
        UsageError: something is there that must not be replaced.
        EnvironmentFailure: ``root`` cannot be renamed.
    """
    try:
        if replace:
            _exchange(folder, root)
        else:
            files.rename(folder, root)  # replaces an empty folder, and nothing else
    except OSError as error:
        if error.errno in _OCCUPIED:
            raise UsageError(
                f"output folder {root} is not empty any more: another program has written there"
            ) from error
        if error.errno in _NO_RENAME:
            raise EnvironmentFailure(
                f"{root} cannot be renamed ({error.strerror}): it is a mount point, or comes from "
                "a container image; copy it to a folder inside a volume and use that"
            ) from error
        raise
    files.sync(root.parent)


def _exchange(folder: Path, root: Path) -> None:
    try:
        files.exchange(folder, root)
    except OSError as error:
        if error.errno not in _NO_EXCHANGE:
            raise
        _swap(folder, root)


def _swap(folder: Path, root: Path) -> None:
    """`files.exchange` in three steps; `recover` mends what a crash between them leaves."""
    aside = _aside(folder)
    files.rename(root, aside)
    files.rename(folder, root)
    files.rename(aside, folder)


def recover(folder: Path, root: Path) -> None:
    """Put a version back that a crash within `publish` left aside."""
    aside = _aside(folder)
    if aside.exists():
        if is_vacant(root):
            files.rename(aside, root)
        else:
            shutil.rmtree(aside)


def _aside(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.before")
