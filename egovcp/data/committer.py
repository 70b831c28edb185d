"""Turns sealed episodes into a dataset, shard by shard, and never into anything less.

At every moment ``root`` either does not exist or is a complete dataset of episodes 0..n-1 of the
run (after a removal of episodes: without those). What is sealed but not committed, and the lock,
lie in a hidden folder beside it::

    .NAME.collect/
        lock           held while a collector runs
        run.json       what the run is, until a dataset says so
        sealed/        episodes that wait for the shard before them to be complete
        next/          the version that is being built
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

from egovcp.atomic import removed_on_error
from egovcp.data import files, metadata, schema
from egovcp.data.continued import read_version
from egovcp.data.destination import is_vacant, make_parent, require_replaceable, resolve_root
from egovcp.data.encoded import EncodedEpisode
from egovcp.data.lock import only_writer
from egovcp.data.provenance import Provenance, parse_provenance
from egovcp.data.spool import Spool
from egovcp.data.version import Contents, Version, publish, recover
from egovcp.errors import DataError, EnvironmentFailure, UsageError

type Agree = Callable[[Provenance], None]


def work_folder(root: Path) -> Path:
    """Where a collection keeps what is not in the dataset yet; beside the real folder if ``root``
    is a symbolic link."""
    real = resolve_root(root)
    return real.with_name(f".{real.name}.collect")


class Committer:
    """Knows which episodes of a run are safe, and commits them. Made by `committing`."""

    def __init__(self, root: Path, provenance: Provenance, shard_episodes: int) -> None:
        self.root = root
        self.provenance = provenance
        self.spool = Spool(work_folder(root) / "sealed")
        self.committed = 0
        """Episodes in the dataset."""
        self.frames = 0
        """Frames in the dataset."""
        self.next_number = 0
        """Number, in the run, of the next episode to commit. It is `committed`, unless episodes
        were removed from the dataset: those are not collected again."""
        self._contents = Contents(shard_episodes)
        self._tail: list[EncodedEpisode] = []
        self._sealed: set[int] = set()

    @property
    def sealed(self) -> int:
        """Episodes that wait to be committed."""
        return len(self._sealed)

    def missing(self, episodes: int) -> list[int]:
        """Numbers that are not sealed yet of a dataset of so many episodes in all."""
        last = self.next_number + episodes - self.committed
        return [n for n in range(self.next_number, last) if n not in self._sealed]

    def note(self, number: int) -> None:
        """An episode has been put into the spool."""
        self._sealed.add(number)

    def ready(self) -> int:
        """How many sealed episodes follow the committed ones without a gap."""
        count = 0
        while self.next_number + count in self._sealed:
            count += 1
        return count

    @property
    def shard_is_ready(self) -> bool:
        """Whether the sealed episodes complete the shard that comes next."""
        size = self._contents.shard_episodes
        return self.ready() >= size - len(self._tail)

    def commit(self) -> list[int]:
        """Commit every sealed episode that follows without a gap; their numbers.

        When it returns they are in the dataset, flushed to the disk. If it fails the dataset is as
        it was, and nothing sealed is lost.

        Raises:
            OSError: the disk is full or broken.
            DataError: the dataset is not the one that was committed.
        """
        numbers = list(range(self.next_number, self.next_number + self.ready()))
        episodes = self._take(numbers)
        if episodes:
            self._publish(episodes)
            self.next_number += len(episodes)
            self._sealed.difference_update(numbers)
            self.spool.drop_before(self.next_number)
        return numbers[: len(episodes)]

    def _take(self, numbers: list[int]) -> list[EncodedEpisode]:
        """The episodes up to the first that is not whole any more, which becomes missing."""
        out = []
        for number in numbers:
            encoded = self.spool.get(number)
            if encoded is None:
                self._sealed.discard(number)
                break
            out.append(encoded)
        return out

    def _publish(self, episodes: list[EncodedEpisode]) -> None:
        previous = self.root if self.committed else None
        if previous is not None and not (self.root / schema.INFO_PATH).is_file():
            raise DataError(f"{self.root} has been removed or changed during the collection")
        version = Version(self._next, self.provenance, self._contents, previous)
        try:
            for encoded in (*self._tail, *episodes):
                version.add(encoded)
            contents = version.close()
            publish(self._next, self.root, replace=previous is not None)
        finally:
            version.discard()
        self.committed, self.frames = len(contents.records), contents.frames
        self._contents, self._tail = contents.split([*self._tail, *episodes])

    @property
    def _next(self) -> Path:
        return work_folder(self.root) / "next"

    def _load(self, agree: Agree) -> None:
        """Take up what an earlier run left."""
        recover(self._next, self.root)
        shutil.rmtree(self._next, ignore_errors=True)
        run = work_folder(self.root) / "run.json"
        if not is_vacant(self.root):
            existing = read_version(self.root)
            agree(existing.provenance)
            self._contents, self._tail = existing.contents, existing.tail
            self.next_number = existing.next_number
        elif run.is_file():
            agree(parse_provenance(metadata.load_object(run), run))
        self.committed = len(self._contents.records) + len(self._tail)
        self.frames = self._contents.frames + sum(map(len, self._tail))
        self.spool.folder.mkdir(exist_ok=True)
        self.spool.sweep()
        self.spool.drop_before(self.next_number)
        self._sealed = self.spool.numbers()
        with removed_on_error(run.with_suffix(".partial")) as partial:
            partial.unlink(missing_ok=True)
            files.write_json(partial, asdict(self.provenance))
            files.sync(partial)
            files.rename(partial, run)


@contextmanager
def committing(
    root: Path,
    provenance: Provenance,
    shard_episodes: int = schema.SHARD_EPISODES,
    resume: Agree | None = None,
) -> Iterator[Committer]:
    """A committer that alone may write the dataset at ``root``.

    Args:
        root: the dataset; a symbolic link stands for the folder that it leads to.
        provenance: what its ``meta/collection.json`` will say.
        shard_episodes: episodes per shard of a new dataset; an old one keeps its own.
        resume: take up a dataset or an unfinished collection that is there; called with its
            provenance, it raises if the two cannot be one. None: there must be none.

    Raises:
        UsageError: something is there and ``resume`` is None, or ``root`` cannot exist.
        EnvironmentFailure: another process writes it, nothing can be written there, or it is a
            mount point.
        DataError: what is there is damaged.
    """
    root = resolve_root(root)
    make_parent(root)
    work = work_folder(root)
    if resume is None:
        _require_nothing(root, work)
    require_replaceable(root)
    try:
        work.mkdir(exist_ok=True)
    except OSError as error:
        raise EnvironmentFailure(f"cannot write beside {root}: {error.strerror}") from error
    with only_writer(root, work):
        committer = Committer(root, provenance, shard_episodes)
        try:
            committer._load(resume or _nothing_to_agree)
            yield committer
        finally:
            # asked of the disk: a run that was refused has not looked at what is sealed
            if not any((work / "sealed").glob("*.arrow")):
                with suppress(OSError):
                    shutil.rmtree(work)


def _nothing_to_agree(provenance: Provenance) -> None:
    """A new collection has no predecessor."""


def _require_nothing(root: Path, work: Path) -> None:
    if not is_vacant(root):
        raise UsageError(
            f"{root} exists already; continue it with --resume, or choose another --dataset.root"
        )
    if any((work / "sealed").glob("*.arrow")):
        raise UsageError(
            f"an unfinished collection of {root} lies in {work}; continue it with --resume, or "
            "remove that folder"
        )
