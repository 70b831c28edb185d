"""Monte Carlo return and termination targets, as the paper's losses need them.

The return of row t is ``sum over i < K of gamma^i r_{t+i}``, with zeros after the end of
the episode. After a termination those zeros are correct. After a truncation they are not, so
such rows are masked by a rule that does not depend on the outcome: a row is valid iff
t + K <= the *planned* length. (Masking by outcome would keep the returns of failures and
drop those of survivors.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.bounds import bounded, check_bounds
from egovcp.errors import UsageError, suggest

ReturnScaling = Literal["dataset", "none"]


@dataclass(frozen=True)
class ReturnConfig:
    """Discount and reward weights of Q, and the Monte Carlo returns that normalise its target.

    By default Q is fitted to a critic (`q_target` privileged), and these returns only give the
    target's mean and standard deviation; with `q_target` mc they are the target."""

    gamma: float = bounded(spec.GAMMA, least=0, most=1)
    """Discount per planner tick."""
    steps: int = bounded(spec.RETURN_STEPS, least=1, most=100_000)
    """Horizon K of the Monte Carlo returns, planner ticks."""
    weights: dict[str, float] = field(default_factory=dict)
    """Weights of reward terms, '{block: 2.0}'; 1 for terms not listed, 0 for those that the planner
    computes (pose, action_rate)."""
    keep_truncated: bool = False
    """Use Monte Carlo returns that the time limit cuts short, too (the paper's choice)."""
    scale: ReturnScaling = "dataset"
    """Normalisation of Q's target: by the returns of the dataset (over all tasks), or none."""

    def check(self, flag: str = "--returns") -> None:
        """Raise `UsageError`, which names options of ``flag``, for invalid values."""
        check_bounds(self, f"{flag}.")
        for name, weight in self.weights.items():
            if name not in spec.REWARD_TERMS:
                raise UsageError(
                    f"{flag}.weights: unknown reward term {name!r}"
                    f"{suggest(name, spec.REWARD_TERMS)}"
                )
            if not math.isfinite(weight):
                raise UsageError(f"{flag}.weights: {name} is {weight}, expected a finite number")

    @property
    def term_weights(self) -> NDArray[np.float64]:
        """(6,) weight of each of ``spec.REWARD_TERMS`` in the target of Q."""
        default = {name: float(name not in spec.ACTION_TERMS) for name in spec.REWARD_TERMS}
        return np.array(list((default | self.weights).values()))

    def target_reward(
        self, reward: NDArray[np.floating], terms: NDArray[np.floating]
    ) -> NDArray[np.float32]:
        """The weighted sum (T,) of the reward terms (T, 6) of ``reward`` (T,).

        Of an episode without recorded terms (zeros), the reward itself.
        """
        extra = np.asarray(terms, np.float64) @ (self.term_weights - 1.0)
        return (reward + extra).astype(np.float32)


def mc_return(
    reward: NDArray[np.floating], gamma: float = spec.GAMMA, steps: int = spec.RETURN_STEPS
) -> NDArray[np.float32]:
    """Discounted sum (T,) of the next ``steps`` rewards at every row of one episode.

    ``reward`` (T,) is that after each row's action; rewards past the episode's end count as zero.
    """
    discount = gamma ** np.arange(steps, dtype=np.float64)
    padded = np.concatenate([np.asarray(reward, dtype=np.float64), np.zeros(steps - 1)])
    return np.correlate(padded, discount, mode="valid").astype(np.float32)


def mc_valid(
    length: int, time_limit: int, steps: int = spec.RETURN_STEPS, keep_truncated: bool = False
) -> NDArray[np.bool_]:
    """Rows of one episode whose return is not cut short by the time limit, ``(length,)``.

    With ``keep_truncated`` every row is valid: the paper's truncated returns, whose bias is the
    epsilon-bar of its section III-D.
    """
    return (np.arange(length) + steps <= time_limit) | keep_truncated


def is_terminal(done: NDArray[np.bool_], truncated: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether the state at t + 1, after row t's action, is a failure; ``(T,)``.

    This is the target of D at t + 1. As the observation that follows a termination is not
    stored, D is evaluated there on the state predicted from row t, hence one flag per
    row t, called ``terminal_next`` in a batch.
    """
    return done & ~truncated
