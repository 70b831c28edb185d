"""Monte Carlo return and termination targets, as the paper's losses need them.

The return of row t is ``sum over i < K of gamma^i r_{t+i}``, with zeros after the end of
the episode. After a termination those zeros are correct. After a truncation they are not, so
such rows are masked by a rule that does not depend on the outcome: a row is valid iff
t + K <= the *planned* length. (Masking by outcome would keep the returns of failures and
drop those of survivors.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.bounds import bounded, check_bounds

ReturnScaling = Literal["dataset", "none", "per_task"]


@dataclass(frozen=True)
class ReturnConfig:
    """The Monte Carlo target of Q."""

    gamma: float = bounded(spec.GAMMA, least=0, most=1)
    """Discount per planner tick."""
    steps: int = bounded(spec.RETURN_STEPS, least=1, most=100_000)
    """Horizon K, planner ticks."""
    keep_truncated: bool = False
    """Train on returns that the time limit cuts short, too (the paper's choice)."""
    scale: ReturnScaling = "dataset"
    """Normalisation of the return targets: dataset (over all tasks), none, or per_task (an
    ablation)."""

    def check(self, flag: str = "--returns") -> None:
        """Raise `UsageError`, which names options of ``flag``, for invalid values."""
        check_bounds(self, f"{flag}.")


def mc_return(
    reward: NDArray[np.floating], gamma: float = spec.GAMMA, steps: int = spec.RETURN_STEPS
) -> NDArray[np.float32]:
    """Discounted sum of the next ``steps`` rewards at every row of one episode.

    Args:
        reward: (T,) reward after the action of each row.
        gamma: discount per planner tick.
        steps: horizon K; rewards past the episode's end count as zero.

    Returns:
        (T,) returns.
    """
    discount = gamma ** np.arange(steps, dtype=np.float64)
    padded = np.concatenate([np.asarray(reward, dtype=np.float64), np.zeros(steps - 1)])
    return np.correlate(padded, discount, mode="valid").astype(np.float32)


def mc_valid(
    length: int, time_limit: int, steps: int = spec.RETURN_STEPS, keep_truncated: bool = False
) -> NDArray[np.bool_]:
    """Rows of one episode whose return is not cut short by the time limit, ``(length,)``.

    Args:
        length: rows of the episode.
        time_limit: planned rows; more than ``length`` after a termination.
        steps: horizon K of the return.
        keep_truncated: every row is valid: the paper's truncated returns, whose bias is
            the epsilon-bar of its section III-D.
    """
    return (np.arange(length) + steps <= time_limit) | keep_truncated


def is_terminal(done: NDArray[np.bool_], truncated: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether the state at t + 1, after row t's action, is a failure; ``(T,)``.

    This is the target of D at t + 1. As the observation that follows a termination is not
    stored, D is evaluated there on the state predicted from row t, hence one flag per
    row t, called ``terminal_next`` in a batch.
    """
    return done & ~truncated
