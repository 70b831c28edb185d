"""Closed-loop results of several seeds on the same scenarios, and their paired differences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.intervals import Interval, bootstrap, wilson
from egovcp_experiment.store import Record

type Array = NDArray[np.float64]

_TRIALS: Final = 10  # as the paper counts them


@dataclass(frozen=True)
class Outcome:
    """S training seeds on the same E scenarios."""

    reward: Array
    """(S, E) sum over the episode."""
    steps: Array
    """(S, E) planner ticks."""
    success: Array
    """(S, E) 0 or 1."""
    plan_ms: tuple[float, ...] = ()
    """(S,) median time per plan and robot, ms."""
    parts: Mapping[str, Array] = field(default_factory=dict)
    """(S, E) 0 or 1 for each part of a sequence of tasks; of a single task, nothing."""

    @property
    def success_rate(self) -> float:
        """Mean over seeds and scenarios."""
        return float(self.success.mean())

    @property
    def part_rates(self) -> dict[str, float]:
        """Success of each part of a sequence, mean over seeds and scenarios."""
        return {name: float(each.mean()) for name, each in self.parts.items()}

    @property
    def success_interval(self) -> Interval:
        """Of one seed Wilson's; of several, from drawing scenarios again."""
        if len(self.success) == 1:
            return wilson(int(self.success.sum()), self.success.size)
        return bootstrap(lambda i: _mean(self.success, i), self.success.shape[1])

    @property
    def reward_per_step(self) -> float:
        """All rewards over all steps."""
        return float(self.reward.sum() / self.steps.sum())

    @property
    def reward_interval(self) -> Interval:
        """From drawing scenarios again."""
        return bootstrap(self._reward_per_step, self.reward.shape[1])

    @property
    def reward_of_seeds(self) -> Array:
        """(S,) reward per step of each training."""
        each: Array = self.reward.sum(1) / self.steps.sum(1)
        return each

    @property
    def reward_spread(self) -> float | None:
        """Standard deviation of reward per step over training seeds; None of one seed."""
        return float(np.std(self.reward_of_seeds, ddof=1)) if len(self.reward) > 1 else None

    @property
    def reward_trial_spread(self) -> float | None:
        """Standard deviation of reward per step over trials, a tenth of the scenarios played with
        one training each; None of a single scenario."""
        count = min(_TRIALS, self.reward.shape[1])
        if count < 2:
            return None
        parts = np.array_split(np.arange(self.reward.shape[1]), count)
        trials = [self.reward[:, p].sum(1) / self.steps[:, p].sum(1) for p in parts]
        return float(np.std(trials, ddof=1))

    def _reward_per_step(self, i: NDArray[np.int64]) -> Array:
        return _mean(self.reward, i) / _mean(self.steps, i)

    def success_gain(self, other: Outcome) -> tuple[float, Interval]:
        """Success rate minus another's on the same scenarios."""
        difference = self.success.mean(0) - other.success.mean(0)
        interval = bootstrap(lambda i: difference[i].mean(1), len(difference))
        return float(difference.mean()), interval

    def reward_gain(self, other: Outcome) -> tuple[float, Interval]:
        """Reward per step minus another's on the same scenarios."""
        interval = bootstrap(
            lambda i: self._reward_per_step(i) - other._reward_per_step(i), self.reward.shape[1]
        )
        return self.reward_per_step - other.reward_per_step, interval

    def reward_gain_of_wins(self, other: Outcome) -> tuple[float, Interval] | None:
        """The same of episodes in which both succeed, where losses of neither count; None where
        there are none."""
        both = self.success * other.success
        at = both.any(0)  # in these scenarios, with one of the seeds at least
        if not at.any():
            return None

        def won(of: Outcome) -> Outcome:
            return Outcome((of.reward * both)[:, at], (of.steps * both)[:, at], both[:, at])

        return won(self).reward_gain(won(other))

    def figures(self) -> dict[str, Any]:
        """For programs."""
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


def outcome(
    records: Mapping[str, Record], cells: Iterable[str], task: str, controller: str = "planner"
) -> Outcome | None:
    """What the cells, one for each seed, say of a controller on a task; None if none is there."""
    rows = [records[name]["figures"][task][controller] for name in cells if name in records]
    if not rows:
        return None

    def column(name: str) -> Array:
        return np.array([row["played"][name] for row in rows], np.float64)

    times = tuple(float(row["plan_ms_p50"]) for row in rows)
    parts = {
        part: np.array([row["played"]["parts"][part] for row in rows], np.float64)
        for part in rows[0]["played"].get("parts", ())
    }
    return Outcome(column("reward"), column("steps"), column("success"), times, parts)


def side_by_side(
    records: Mapping[str, Record], cell: str, task: str, controllers: Iterable[str]
) -> dict[str, Outcome]:
    """Controllers that one cell played, those that are there."""
    found = {name: outcome(records, [cell], task, name) for name in controllers}
    return {name: played for name, played in found.items() if played is not None}
