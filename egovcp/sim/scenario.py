"""Identity and random streams of an episode, which is a pure function of its scenario."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np

from egovcp.errors import UsageError
from egovcp.sim.tasks.registry import seed_key

# Added to the user's seed, so that no scenario serves two purposes; those of collections and of PPO
# count from 0.
HELD_OUT: Final = 1_000_000_000  # evaluation and deployment
SEARCH: Final = 2_000_000_000  # for the best constant action
VALIDATION: Final = 3_000_000_000  # during training
STUDIES: Final = 4_000_000_000  # of egovcp-experiment
CHECK_SEED: Final = 6_000_000_000  # for `check_task`


def require_training_seed(seed: int) -> None:
    """Raise `UsageError` if the scenarios of ``seed`` are for evaluation."""
    if seed >= HELD_OUT:
        raise UsageError(
            f"--seed={seed}: expected a number from 0 to {HELD_OUT - 1}; the scenarios beyond are "
            "for evaluation"
        )


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
