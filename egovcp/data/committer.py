"""Turns staged episodes into a dataset, shard by shard, safe against crashes.

At every moment ``root`` either does not exist or is a complete dataset of episodes 0..n-1 of the
collection (without those that were removed from it). Staged episodes and the lock are in a hidden
folder beside it::

    .NAME.collect/
        lock           held while a collector runs
        run.json       provenance of the collection, until the dataset has it
        sealed/        staged episodes, which wait until the shards before theirs are complete
        next/          the version that is being written
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Final, NamedTuple

from egovcp import spec
from egovcp.data import metadata, schema, stats
from egovcp.data.destination import (
    is_vacant,
    make_parent,
    require_replaceable,
    resolve_root,
    writer_lock,
)
from egovcp.data.metadata import load_hashes, verify_hashes
from egovcp.data.parquet import data_errors, open_parquet
from egovcp.data.provenance import SOURCES, Provenance, parse_provenance
from egovcp.data.reader import DatasetReader
from egovcp.data.source import Source
from egovcp.data.staging import EncodedEpisode, StagingDir, encode
from egovcp.data.writer import (
    VersionContents,
    VersionWriter,
    aside_folder,
    publish_version,
    recover,
    shard_paths,
)
from egovcp.errors import DataError, EnvironmentFailure, UsageError
from egovcp.files import write_json

_STAGING: Final = "sealed"  # name on disk, which unfinished collections of older versions have
_NEXT: Final = "next"

type CheckProvenance = Callable[[Provenance], None]


def work_folder(root: Path) -> Path:
    """Folder of a collection's lock and staged episodes; if ``root`` is a symbolic link, beside its
    target."""
    real = resolve_root(root)
    return real.with_name(f".{real.name}.collect")


class Committer:
    """Tracks and commits the staged episodes of a collection. Created by `open_committer`."""

    def __init__(self, root: Path, provenance: Provenance, shard_episodes: int) -> None:
        self.root = root
        self.provenance = provenance
        self.staging = StagingDir(work_folder(root) / _STAGING)
        self.committed = 0
        """Episodes in the dataset."""
        self.frames = 0
        """Frames in the dataset."""
        self.next_number = 0
        """Number, in the collection, of the next episode to commit. It is more than `committed` if
        episodes were removed from the dataset: those are not collected again."""
        self._contents = VersionContents(shard_episodes)
        self._tail: list[EncodedEpisode] = []
        self._staged: set[int] = set()

    @property
    def staged(self) -> int:
        """Episodes that wait to be committed."""
        return len(self._staged)

    def missing(self, episodes: int) -> list[int]:
        """Numbers of the episodes that are still to be staged for a dataset of ``episodes``."""
        last = self.next_number + episodes - self.committed
        return [n for n in range(self.next_number, last) if n not in self._staged]

    def mark_staged(self, number: int) -> None:
        """Register an episode that was put into `staging`."""
        self._staged.add(number)

    def ready(self) -> int:
        """Number of staged episodes that follow the committed ones without a gap."""
        count = 0
        while self.next_number + count in self._staged:
            count += 1
        return count

    @property
    def next_shard_is_complete(self) -> bool:
        """Whether the staged episodes complete the next shard."""
        return self.ready() + len(self._tail) >= self._contents.shard_episodes

    def commit(self) -> list[int]:
        """Commit every staged episode that follows without a gap; returns their numbers.

        On return they are in the dataset, flushed to the disk. On failure the dataset is unchanged
        and no staged episode is lost.
        """
        numbers = list(range(self.next_number, self.next_number + self.ready()))
        episodes: list[EncodedEpisode] = []
        for number in numbers:
            encoded = self.staging.get(number)
            if encoded is None:  # damaged
                self._staged.discard(number)
                break
            episodes.append(encoded)
        committed = numbers[: len(episodes)]
        if committed:
            self._publish(episodes)
            self.next_number += len(committed)
            self._staged.difference_update(committed)
            self.staging.drop_before(self.next_number)
        return committed

    def _publish(self, episodes: list[EncodedEpisode]) -> None:
        previous = self.root if self.committed else None
        if previous is not None and not (self.root / schema.INFO_PATH).is_file():
            raise DataError(f"{self.root} has been removed or changed during the collection")
        version = VersionWriter(self._next, self.provenance, self._contents, previous)
        try:
            for encoded in (*self._tail, *episodes):
                version.add(encoded)
            contents = version.close()
            publish_version(self._next, self.root, replace=previous is not None)
        finally:
            version.discard()
        self.committed, self.frames = version.episodes, version.frames
        tail = [*self._tail, *episodes]
        self._tail = tail[len(tail) - (self.committed - len(contents.records)) :]
        self._contents = contents

    @property
    def _next(self) -> Path:
        return work_folder(self.root) / _NEXT

    def _load(self, check: CheckProvenance) -> None:
        recover(self._next, self.root)
        shutil.rmtree(self._next, ignore_errors=True)
        run = work_folder(self.root) / "run.json"
        if not is_vacant(self.root):
            state = load_append_state(self.root)
            check(state.provenance)
            self._contents, self._tail = state.contents, state.tail
            self.next_number = state.next_number
        elif run.is_file():
            check(parse_provenance(metadata.load_json_object(run), run))
        self.committed = len(self._contents.records) + len(self._tail)
        self.frames = self._contents.frames + sum(map(len, self._tail))
        self.staging.folder.mkdir(exist_ok=True)
        self.staging.remove_invalid()
        self.staging.drop_before(self.next_number)
        self._staged = self.staging.numbers()
        write_json(run, asdict(self.provenance))


@contextmanager
def open_committer(
    root: Path,
    provenance: Provenance,
    shard_episodes: int = schema.SHARD_EPISODES,
    resume: CheckProvenance | None = None,
) -> Iterator[Committer]:
    """Lock the dataset at ``root`` and yield its committer.

    Args:
        root: the dataset; a symbolic link is followed.
        shard_episodes: episodes per shard of a new dataset; an existing one keeps its value.
        resume: called with the provenance of an existing dataset or unfinished collection; it
            raises if that cannot be continued. None: there must be none.
    """
    root = resolve_root(root)
    make_parent(root)
    work = work_folder(root)
    if resume is None:
        _require_unused(root, work)
    require_replaceable(root)
    try:
        work.mkdir(exist_ok=True)
    except OSError as error:
        raise EnvironmentFailure(f"cannot write beside {root}: {error.strerror}") from error
    with writer_lock(root, work):
        committer = Committer(root, provenance, shard_episodes)
        try:
            committer._load(resume or (lambda _: None))
            yield committer
        finally:
            # On the disk: a run that was refused has not loaded the staged episodes.
            if not any((work / _STAGING).glob("*.arrow")):
                with suppress(OSError):
                    shutil.rmtree(work)


def _require_unused(root: Path, work: Path) -> None:
    if not is_vacant(root):
        raise UsageError(
            f"{root} exists already; continue it with --resume, or choose another --dataset.root"
        )
    if (aside := aside_folder(work / _NEXT)).exists():
        raise UsageError(
            f"a collection was interrupted while it replaced {root}, whose episodes are now in "
            f"{aside}; continue it with --resume, which restores them"
        )
    if any((work / _STAGING).glob("*.arrow")):
        raise UsageError(
            f"an unfinished collection of {root} is in {work}; continue it with --resume, or "
            "remove that folder"
        )


class AppendState(NamedTuple):
    """What is needed to append to a dataset."""

    contents: VersionContents  # of the complete shards
    tail: list[EncodedEpisode]  # episodes of the last shard if it is not complete
    provenance: Provenance
    next_number: int  # of the collection


def load_append_state(root: Path) -> AppendState:
    """Verify a dataset and read what is needed to append to it."""
    verify_hashes(root)
    reader, hashes = DatasetReader(Source(root, "")), load_hashes(root)
    if missing := [key for key in spec.OPTIONAL_KEYS if key not in reader.features]:
        raise DataError(
            f"{root} was written by an earlier version, without {', '.join(missing)}, and cannot "
            "be extended; collect into another folder, then join the two with `egovcp-dataset "
            "merge`"
        )
    episodes, size = len(reader), reader.provenance.get("shard_episodes")
    if not isinstance(size, int) or size < 1 or not hashes:
        raise DataError(
            f"{root} was not written in shards by egovcp and cannot be extended; "
            "`egovcp-dataset repair` writes a copy that can"
        )
    shards = []
    full = episodes // size
    kept = full * size
    for number in range(full):
        path = root / shard_paths(number)[1]
        with data_errors(path):
            shards.append(open_parquet(path).read())
    matrices = [stats.from_arrow(shard, reader.robot) for shard in shards]
    lengths = [shard["length"].to_pylist() for shard in shards]
    present = {record["task"] for record in reader.records[:kept]}
    contents = VersionContents(
        size,
        [json.dumps(record) for record in reader.records[:kept]],
        {task: index for index, task in sorted(reader.task_names.items()) if task in present},
        [(stats.aggregate(matrices[n], lengths[n]), sum(lengths[n])) for n in range(full)],
        {name: hashes[name] for number in range(full) for name in shard_paths(number)},
        reader.robot,
    )
    tail = [encode(reader.read(index)) for index in range(kept, episodes)]
    return AppendState(contents, tail, reader.origin, _next_number(reader))


def _next_number(reader: DatasetReader) -> int:
    """The highest number plus one, so that no episode is collected twice."""
    path = reader.root / schema.COLLECTION_PATH
    elsewhere = (
        f"{reader.root} holds episodes of several collections and cannot be extended; collect into "
        "another folder, then join the two with `egovcp-dataset merge`"
    )
    if SOURCES in reader.origin.config:
        raise UsageError(elsewhere)
    first: dict[int, int] = {}  # episode number -> index in the dataset
    for index in range(len(reader)):
        facts = reader.metadata(index)
        number = facts.get("episode", index)
        if not isinstance(number, int) or isinstance(number, bool) or number < 0:
            raise DataError.at(path, f"its number is {number!r}, expected an integer", index)
        if facts.get("seed", reader.origin.seed) != reader.origin.seed:
            raise UsageError(elsewhere)
        if first.setdefault(number, index) != index:
            problem = f"is number {number} of the collection, as episode {first[number]}"
            raise DataError.at(path, f"{problem}; `egovcp-dataset repair` keeps one", index)
    return max(first, default=-1) + 1
