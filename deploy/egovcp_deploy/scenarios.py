"""Which scenarios are played: never those that data were collected from.

Collection counts its seeds from 0. Evaluation and deployment add `HELD_OUT`, the search of
the best constant action adds `SEARCH`, so neither ever meets a scenario of the training
data, nor the other's, under whatever ``--seed``.
"""

from __future__ import annotations

from typing import Final

from egovcp.errors import UsageError
from egovcp.sim.scenario import Scenario

HELD_OUT: Final = 1_000_000_000
SEARCH: Final = 2_000_000_000


def held_out(task: str, seed: int, episode: int) -> Scenario:
    """Scenario ``episode`` of evaluation and deployment under the user's ``seed``.

    Raises:
        UsageError: the seed is negative or would leave the held-out range.
    """
    return Scenario(task, HELD_OUT + _checked(seed), episode)


def for_search(task: str, seed: int, episode: int) -> Scenario:
    """Scenario ``episode`` for choosing the best constant action.

    Raises:
        UsageError: as `held_out`.
    """
    return Scenario(task, SEARCH + _checked(seed), episode)


def _checked(seed: int) -> int:
    if not 0 <= seed < SEARCH - HELD_OUT:
        raise UsageError(f"--seed={seed}: expected a number from 0 to {SEARCH - HELD_OUT - 1}")
    return seed
