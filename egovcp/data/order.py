"""In which order a bounded stream reads the episodes: endless, by shards, exactly resumable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain, groupby
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovcp.data.index import EpisodeIndex
from egovcp.data.mix import Groups
from egovcp.errors import UsageError

#: Files whose episodes are shuffled with each other: few enough that they stay open.
FILES_AT_ONCE: Final = 4

type Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class Shard:
    """Which part of the data a worker of a rank reads; every part has its own episodes."""

    rank: int = 0
    """This process."""
    ranks: int = 1
    """Processes that train together."""
    worker: int = 0
    """This worker of the process."""
    workers: int = 1
    """Workers of each process."""

    def check(self) -> None:
        """Raise `UsageError` unless rank and worker lie within their numbers."""
        if not (0 <= self.rank < self.ranks and 0 <= self.worker < self.workers):
            raise UsageError(
                f"rank {self.rank} of {self.ranks}, worker {self.worker} of {self.workers}: "
                "expected to count from 0"
            )

    @property
    def index(self) -> int:
        """Number of the shard."""
        return self.rank * self.workers + self.worker

    @property
    def count(self) -> int:
        """Number of shards."""
        return self.ranks * self.workers


class _Epoch(NamedTuple):
    """All episodes of a group once, block by block of files."""

    episodes: Numbers
    ends: Numbers
    """(blocks,) where each block ends."""
    files: list[list[int]]
    """For each block, an episode of each of its files."""


class EpisodeOrder:
    """Endless epochs over the episodes of each group in one shard."""

    def __init__(self, index: EpisodeIndex, groups: Groups, shard: Shard, seed: int) -> None:
        """Deal the files out.

        Raises:
            UsageError: a group has fewer episodes than there are shards.
        """
        shard.check()
        self._seed = (seed, shard.index)
        drawn = np.flatnonzero(groups.share > 0)
        self._files = [_dealt(_files(index, groups.of == g), shard) for g in drawn]
        self._epoch = [0] * len(drawn)
        self._cursor = [0] * len(drawn)
        self._epochs = [self._shuffle(g) for g in range(len(drawn))]
        # An episode yields windows in proportion to its length: groups of long ones come less often
        mean = np.array([index.length[np.concatenate(files)].mean() for files in self._files])
        rate = groups.share[drawn] / mean
        self._rate = rate / rate.sum()

    @property
    def episodes(self) -> Numbers:
        """All episodes of the shard, in the order of the index."""
        return np.sort(np.concatenate([part for files in self._files for part in files]))

    def draw(self, rng: np.random.Generator) -> int:
        """The next episode of a group that ``rng`` chooses."""
        group = int(rng.choice(len(self._rate), p=self._rate)) if len(self._rate) > 1 else 0
        if self._cursor[group] == len(self._epochs[group].episodes):
            self._epoch[group] += 1
            self._cursor[group] = 0
            self._epochs[group] = self._shuffle(group)
        self._cursor[group] += 1
        return int(self._epochs[group].episodes[self._cursor[group] - 1])

    def upcoming(self) -> list[int]:
        """An episode of each file that is read from now on, for a few files of each group."""
        found: list[int] = []
        for cursor, epoch in zip(self._cursor, self._epochs, strict=True):
            block = int(np.searchsorted(epoch.ends, cursor, side="right"))
            found += chain.from_iterable(epoch.files[block : block + 2])
        return found

    def state_dict(self) -> dict[str, Any]:
        """JSON-compatible."""
        return {"epoch": list(self._epoch), "cursor": list(self._cursor)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where another order over the same episodes stood."""
        self._epoch, self._cursor = list(state["epoch"]), list(state["cursor"])
        self._epochs = [self._shuffle(g) for g in range(len(self._files))]

    def _shuffle(self, group: int) -> _Epoch:
        """The episodes of a group in the order of its epoch: a few files at a time."""
        rng = np.random.default_rng((*self._seed, group, self._epoch[group]))
        files = self._files[group]
        order = rng.permutation(len(files))
        blocks = [order[i : i + FILES_AT_ONCE] for i in range(0, len(order), FILES_AT_ONCE)]
        together = (np.concatenate([files[f] for f in block]) for block in blocks)
        parts = [rng.permutation(episodes) for episodes in together]
        some = [[int(files[f][0]) for f in block] for block in blocks]
        return _Epoch(np.concatenate(parts), np.cumsum([len(part) for part in parts]), some)


def _files(index: EpisodeIndex, chosen: NDArray[np.bool_]) -> list[Numbers]:
    """The chosen episodes, file by file."""
    files = index.files
    numbers = np.flatnonzero(chosen).tolist()
    return [np.array(list(part)) for _, part in groupby(numbers, key=lambda n: files[n])]


def _dealt(files: list[Numbers], shard: Shard) -> list[Numbers]:
    """The files of one shard; pieces of files where there are fewer files than shards."""
    episodes = sum(map(len, files))
    if episodes < shard.count:
        raise UsageError(
            f"{episodes} episodes of one task and dataset for {shard.count} workers in all; use "
            "fewer workers"
        )
    while len(files) < shard.count:
        largest = max(range(len(files)), key=lambda i: len(files[i]))
        files[largest : largest + 1] = np.array_split(files[largest], 2)
    load = [0] * shard.count
    own: list[Numbers] = []
    for file in sorted(files, key=len, reverse=True):  # the largest first, to whoever has least
        to = load.index(min(load))
        load[to] += len(file)
        if to == shard.index:
            own.append(file)
    return own
