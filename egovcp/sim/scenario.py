"""Which episode: everything random about it is a pure function of its scenario."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np

from egovcp.errors import UsageError, suggest
from egovcp.spec import TASKS

#: Several tasks in one episode, for evaluation: nothing is collected from it, nothing learns it.
SEQUENCE: Final = "sequence"
#: What an episode can be of. Their order is part of what is drawn: new ones come last.
PLAYABLE: Final = (*TASKS, SEQUENCE)


@dataclass(frozen=True)
class Scenario:
    """Names one episode. Equal scenarios give equal episodes, bit for bit.

    Raises:
        UsageError: the task is unknown, or a number is negative.
    """

    task: str
    """One of `PLAYABLE`."""
    seed: int
    """Seed of the whole collection or evaluation."""
    episode: int
    """Index of the episode under that seed."""

    def __post_init__(self) -> None:
        if self.task not in PLAYABLE:
            raise UsageError(f"unknown task {self.task!r}{suggest(self.task, PLAYABLE)}")
        if self.seed < 0 or self.episode < 0:
            raise UsageError(
                f"seed and episode count from 0, found seed={self.seed} episode={self.episode}"
            )

    def rng(self, name: str) -> np.random.Generator:
        """A generator of its own for the quantity ``name``.

        Streams of different names, episodes, seeds and tasks are independent, so a new
        random quantity leaves all others as they were.
        """
        key = (self.episode, PLAYABLE.index(self.task), zlib.crc32(name.encode()))
        entropy = np.random.SeedSequence(self.seed, spawn_key=key)
        return np.random.Generator(np.random.PCG64(entropy))
