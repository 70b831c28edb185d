"""Identity and random streams of an episode, which is a pure function of its scenario."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np

from egovcp.errors import UsageError, suggest
from egovcp.spec import TASKS

#: Several tasks in one episode; for evaluation only.
SEQUENCE: Final = "sequence"
#: Tasks of an episode. Append new ones: random streams depend on the order.
EPISODE_TASKS: Final = (*TASKS, SEQUENCE)


@dataclass(frozen=True)
class Scenario:
    """Identifies one episode. Equal scenarios give equal episodes, bit for bit.

    Raises:
        UsageError: the task is unknown, or a number is negative.
    """

    task: str
    """One of `EPISODE_TASKS`."""
    seed: int
    """Seed of the whole collection or evaluation."""
    episode: int
    """Index of the episode under that seed."""

    def __post_init__(self) -> None:
        if self.task not in EPISODE_TASKS:
            raise UsageError(f"unknown task {self.task!r}{suggest(self.task, EPISODE_TASKS)}")
        if self.seed < 0 or self.episode < 0:
            raise UsageError(
                f"seed and episode count from 0, found seed={self.seed} episode={self.episode}"
            )

    def rng(self, name: str) -> np.random.Generator:
        """Random generator of the quantity ``name``.

        Streams of different names, episodes, seeds and tasks are independent.
        """
        key = (self.episode, EPISODE_TASKS.index(self.task), zlib.crc32(name.encode()))
        entropy = np.random.SeedSequence(self.seed, spawn_key=key)
        return np.random.Generator(np.random.PCG64(entropy))
