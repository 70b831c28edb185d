"""Scores of evaluated episodes, with 95 % intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

type Interval = tuple[float, float]
type Array = NDArray[np.float64]

Z95: Final = 1.959964  # two-sided 95 % quantile of the normal distribution
_RESAMPLES: Final = 4000
_TRIALS: Final = 10  # as in the paper


def wilson(successes: float, trials: int) -> Interval:
    """Wilson's score interval of a rate, at 95 %; valid also at 0 and 1.

    (p + z^2/2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)
    """
    p, n = successes / trials, trials
    middle = p + Z95**2 / (2 * n)
    half = Z95 * math.sqrt(p * (1 - p) / n + Z95**2 / (4 * n * n))
    scale = 1 + Z95**2 / n
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def bootstrap(
    statistic: Callable[[NDArray[np.int64]], NDArray[np.floating]], count: int
) -> Interval:
    """95 % percentile bootstrap interval of a statistic of ``count`` episodes.

    The resamples have a fixed seed. For a paired comparison the statistic reads both measurements
    at the same indices.

    Args:
        statistic: episode indices (R, count) -> the statistic of each row, (R,).
    """
    picks = np.random.default_rng(0).integers(count, size=(_RESAMPLES, count))
    low, high = np.percentile(statistic(picks), [2.5, 97.5])
    return float(low), float(high)


def _paired_interval(differences: Array) -> Interval:
    """95 % interval of the mean of paired differences of successes, in [-1, 1], with one more pair
    of either sign (Agresti and Min, 2005): not of zero width where all pairs are equal."""
    count, total = len(differences) + 2, float(differences.sum())
    square = float(np.square(differences).sum()) + 1 - total**2 / count
    half = Z95 * math.sqrt(square) / count
    return max(-1.0, total / count - half), min(1.0, total / count + half)


def points_range(interval: Sequence[float]) -> str:
    """An interval of differences of rates, percentage points, as ``-3.0 to +8.5``."""
    return f"{100 * interval[0]:+.1f} to {100 * interval[1]:+.1f}"


def signed_range(interval: Sequence[float]) -> str:
    """An interval of rewards per step as ``-0.00120 to +0.00340``."""
    return f"{interval[0]:+.5f} to {interval[1]:+.5f}"


class Gain(NamedTuple):
    """Paired differences of two `EvalScores`, with 95 % intervals over scenarios."""

    reward: float
    """Per step."""
    reward_interval: Interval
    success: float
    success_interval: Interval

    def word(self, better: str = "better", worse: str = "worse", same: str = "undecided") -> str:
        """``better`` or ``worse`` if the interval of the reward's difference excludes 0, else
        ``same``."""
        low, high = self.reward_interval
        return better if low > 0 else worse if high < 0 else same

    def columns(self) -> tuple[str, str]:
        """Success, percentage points, and reward per step, each with its interval."""
        return (
            f"{100 * self.success:+.1f} ({points_range(self.success_interval)})",
            f"{self.reward:+.5f} ({signed_range(self.reward_interval)})",
        )

    def __str__(self) -> str:
        success, reward = self.columns()
        return f"reward per step {reward}, success {success} points"


@dataclass(frozen=True)
class EvalScores:
    """Scores of S training seeds on the same E scenarios."""

    reward: Array
    """(S, E) sum over the episode."""
    steps: Array
    """(S, E) planner ticks."""
    success: Array
    """(S, E) 0 or 1."""
    plan_ms: tuple[float, ...] = ()
    """(S,) median time per plan and robot, ms."""
    parts: Mapping[str, Array] = field(default_factory=dict)
    """(S, E) 0 or 1 for each part of a sequence of tasks."""

    @property
    def success_rate(self) -> float:
        """Mean over seeds and scenarios."""
        return float(self.success.mean())

    @property
    def part_rates(self) -> dict[str, float]:
        """Success rate of each part of a sequence."""
        return {name: float(each.mean()) for name, each in self.parts.items()}

    @property
    def success_interval(self) -> Interval:
        """95 %, Wilson; a scenario is one trial, however many trainings have played it."""
        return wilson(float(self.success.mean(0).sum()), self.success.shape[1])

    @property
    def reward_per_step(self) -> float:
        """Sum of all rewards over sum of all steps."""
        return float(self.reward.sum() / self.steps.sum())

    @property
    def reward_interval(self) -> Interval:
        """95 %, bootstrap over scenarios."""
        return bootstrap(self._reward_per_step, self.reward.shape[1])

    @property
    def reward_of_seeds(self) -> Array:
        """(S,) reward per step of each training."""
        each: Array = self.reward.sum(1) / self.steps.sum(1)
        return each

    @property
    def reward_spread(self) -> float | None:
        """Standard deviation of the reward per step over seeds; None for one seed."""
        return float(np.std(self.reward_of_seeds, ddof=1)) if len(self.reward) > 1 else None

    @property
    def reward_trial_spread(self) -> float | None:
        """Standard deviation of the reward per step over trials; None for a single scenario. A
        trial is a tenth of the scenarios with one seed."""
        count = min(_TRIALS, self.reward.shape[1])
        if count < 2:
            return None
        parts = np.array_split(np.arange(self.reward.shape[1]), count)
        trials = [self.reward[:, p].sum(1) / self.steps[:, p].sum(1) for p in parts]
        return float(np.std(trials, ddof=1))

    def _reward_per_step(self, i: NDArray[np.int64]) -> Array:
        return _mean(self.reward, i) / _mean(self.steps, i)

    def gain(self, other: EvalScores) -> Gain:
        """Differences to ``other`` on the same scenarios."""
        success = self.success.mean(0) - other.success.mean(0)
        return Gain(
            self.reward_per_step - other.reward_per_step,
            bootstrap(lambda i: self._reward_per_step(i) - other._reward_per_step(i), len(success)),
            float(success.mean()),
            _paired_interval(success),
        )

    def figures(self) -> dict[str, Any]:
        """The scores as JSON values."""
        return {
            "seeds": len(self.reward),
            "episodes": self.reward.shape[1],
            "success_rate": self.success_rate,
            "success_ci95": list(self.success_interval),
            "reward_mean": self.reward_per_step,
            "reward_ci95": list(self.reward_interval),
            "reward_sd_over_seeds": self.reward_spread,
            "reward_sd_over_trials": self.reward_trial_spread,
            "plan_ms_p50": list(self.plan_ms),
            **({"parts": self.part_rates} if self.parts else {}),
        }


def _mean(values: Array, picks: NDArray[np.int64]) -> Array:
    """(S, E) values -> (R,) means over seeds and the picked scenarios (R, E)."""
    mean: Array = values.mean(0)[picks].mean(1)
    return mean
