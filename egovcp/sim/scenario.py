"""Identity and random streams of an episode, which is a pure function of its scenario."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from egovcp.errors import UsageError
from egovcp.sim.tasks.registry import seed_key


@dataclass(frozen=True)
class Scenario:
    """Identifies one episode. Equal scenarios give equal episodes, bit for bit.

    Raises:
        UsageError: the task is unknown, or a number is negative.
        EnvironmentFailure: the plugin of the task is defective.
    """

    task: str
    """Name of an installed task."""
    seed: int
    """Seed of the whole collection or evaluation."""
    episode: int
    """Index of the episode under that seed."""

    def __post_init__(self) -> None:
        seed_key(self.task)
        if self.seed < 0 or self.episode < 0:
            raise UsageError(
                f"seed and episode count from 0, found seed={self.seed} episode={self.episode}"
            )

    def rng(self, name: str) -> np.random.Generator:
        """Random generator of the quantity ``name``.

        Streams of different names, episodes, seeds and tasks are independent.
        """
        key = (self.episode, seed_key(self.task), zlib.crc32(name.encode()))
        entropy = np.random.SeedSequence(self.seed, spawn_key=key)
        return np.random.Generator(np.random.PCG64(entropy))
