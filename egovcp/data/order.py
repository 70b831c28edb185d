"""How often and in which order episodes are drawn: weights of datasets and tasks, and epochs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovcp.data.index import EpisodeIndex
from egovcp.errors import UsageError, suggest

#: Files whose episodes are shuffled with each other; few, because they stay open.
FILES_AT_ONCE: Final = 4
#: Episodes ahead of the current one whose files are prefetched.
LOOKAHEAD: Final = 256

type Numbers = NDArray[np.int64]


@dataclass(frozen=True)
class Mix:
    """Weights of datasets and tasks; without any, all rows are equally likely."""

    datasets: tuple[float, ...] = ()
    """Share of each dataset, independent of its size; empty: in proportion to its frames."""
    tasks: Mapping[str, float] = field(default_factory=dict)
    """Task -> factor on its share; 1 for other tasks."""

    @property
    def is_plain(self) -> bool:
        return not self.datasets and not self.tasks

    def check(self) -> None:
        """Raise `UsageError` for invalid weights."""
        given = {"--datasets": self.datasets, "--sampling.tasks": self.tasks.values()}
        for flag, weights in given.items():
            for weight in weights:
                if not (weight >= 0 and math.isfinite(weight)):
                    expected = "expected a finite number of at least 0"
                    raise UsageError(f"{flag}: a weight of {weight}: {expected}")

    def as_dict(self) -> dict[str, Any]:
        return {"datasets": list(self.datasets), "tasks": dict(sorted(self.tasks.items()))}


class EpisodeGroups(NamedTuple):
    """G groups: the episodes of one task in one dataset form a group."""

    of: NDArray[np.int64]  # (E,) group of each episode
    share: NDArray[np.float64]  # (G,) share of the windows; sums to 1


def group_episodes(
    mix: Mix, dataset: NDArray[np.int64], tasks: Sequence[str], length: NDArray[np.int64]
) -> EpisodeGroups:
    """Groups of the episodes by ``dataset`` (E,) and ``tasks`` (E,), with their shares."""
    mix.check()
    for task in mix.tasks:
        if task not in tasks:
            raise UsageError(
                f"--sampling.tasks: no training episode is of task {task!r}"
                f"{suggest(task, {*tasks})}"
            )
    if mix.datasets and len(mix.datasets) <= dataset.max():
        raise UsageError(f"{len(mix.datasets)} weights for {dataset.max() + 1} datasets")
    if mix.is_plain:
        return EpisodeGroups(np.zeros(len(dataset), dtype=np.int64), np.ones(1))
    keys = sorted(set(zip(dataset.tolist(), tasks, strict=True)))
    number = {key: i for i, key in enumerate(keys)}
    of = np.array([number[key] for key in zip(dataset.tolist(), tasks, strict=True)])
    share = np.bincount(of, weights=length).astype(np.float64)
    if mix.datasets:
        frames = np.bincount(dataset, weights=length)
        share *= np.array([mix.datasets[d] / frames[d] for d, _ in keys])
    share *= np.array([mix.tasks.get(task, 1.0) for _, task in keys])
    if not share.sum() > 0:
        raise UsageError(
            "the weights of datasets and tasks leave no episode to draw; give one more than 0"
        )
    return EpisodeGroups(of, share / share.sum())


class EpisodeOrder:
    """Endless epochs over the episodes of each group."""

    def __init__(self, index: EpisodeIndex, groups: EpisodeGroups, seed: int) -> None:
        self._seed = seed
        drawn = np.flatnonzero(groups.share > 0)
        self._files = [_files(index, groups.of == g) for g in drawn]
        self._epoch = [0] * len(drawn)
        self._cursor = [0] * len(drawn)
        self._episodes = [self._shuffle(g) for g in range(len(drawn))]
        # An episode yields windows in proportion to its length, so groups of long ones are rarer.
        mean = np.array([index.length[np.concatenate(files)].mean() for files in self._files])
        rate = groups.share[drawn] / mean
        self._rate = rate / rate.sum()

    def draw(self, rng: np.random.Generator) -> int:
        """The next episode of a group that ``rng`` chooses."""
        group = int(rng.choice(len(self._rate), p=self._rate)) if len(self._rate) > 1 else 0
        if self._cursor[group] == len(self._episodes[group]):
            self._epoch[group] += 1
            self._cursor[group] = 0
            self._episodes[group] = self._shuffle(group)
        self._cursor[group] += 1
        return int(self._episodes[group][self._cursor[group] - 1])

    def upcoming(self) -> list[int]:
        """The next episodes of each group's epoch."""
        groups = zip(self._cursor, self._episodes, strict=True)
        return [int(e) for cursor, part in groups for e in part[cursor : cursor + LOOKAHEAD]]

    def state_dict(self) -> dict[str, Any]:
        return {"epoch": list(self._epoch), "cursor": list(self._cursor)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from the state of another order over the same episodes."""
        self._epoch, self._cursor = list(state["epoch"]), list(state["cursor"])
        self._episodes = [self._shuffle(g) for g in range(len(self._files))]

    def _shuffle(self, group: int) -> Numbers:
        """The episodes of a group in the order of its current epoch."""
        # The 0 and the order of the files are those of earlier versions, whose runs can be resumed.
        rng = np.random.default_rng((self._seed, 0, group, self._epoch[group]))
        files = self._files[group]
        order = rng.permutation(len(files))
        blocks = [order[i : i + FILES_AT_ONCE] for i in range(0, len(order), FILES_AT_ONCE)]
        parts = [rng.permutation(np.concatenate([files[f] for f in block])) for block in blocks]
        return np.concatenate(parts)


def _files(index: EpisodeIndex, chosen: NDArray[np.bool_]) -> list[Numbers]:
    """The chosen episodes of each file, largest files first."""
    files = index.files
    numbers = np.flatnonzero(chosen).tolist()
    parts = [np.array(list(part)) for _, part in groupby(numbers, key=lambda n: files[n])]
    return sorted(parts, key=len, reverse=True)
