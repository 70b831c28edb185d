"""Statistics of played episodes: rates, means and their 95 % confidence intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovcp.intervals import Interval, bootstrap, wilson


@dataclass(frozen=True)
class EpisodeScore:
    """One episode, played by one controller."""

    episode: int
    """Index of the scenario."""
    steps: int
    """Planner ticks until the time limit or the fall."""
    reward: float
    """Sum over the episode."""
    success: bool
    terminated: bool
    plan_ms: list[float] = field(default_factory=list)
    """Time per tick to decide on one action, ms; shared by robots planned together."""
    skipped: int = 0
    """Observations that the policy did not use, because their state was not finite."""
    parts: dict[str, bool] = field(default_factory=dict)
    """Success of each part of a sequence of tasks; of a single task, nothing."""


def paired(
    scores: Sequence[EpisodeScore], others: Sequence[EpisodeScore]
) -> tuple[list[EpisodeScore], list[EpisodeScore]]:
    """The episodes of the scenarios that are in both, in the order of the scenarios."""
    ours, theirs = ({s.episode: s for s in each} for each in (scores, others))
    common = sorted(ours.keys() & theirs.keys())
    return [ours[i] for i in common], [theirs[i] for i in common]


def success_rate(scores: Sequence[EpisodeScore]) -> float:
    """Share of the episodes that succeeded."""
    return sum(score.success for score in scores) / len(scores)


def reward_per_step(scores: Sequence[EpisodeScore]) -> float:
    """Sum of all rewards over the number of all steps."""
    return sum(score.reward for score in scores) / sum(score.steps for score in scores)


def reward_interval(scores: Sequence[EpisodeScore]) -> Interval:
    """Bootstrap interval of `reward_per_step` over episodes."""
    return bootstrap(_reward_per_step(scores), len(scores))


def reward_gain(scores: Sequence[EpisodeScore], others: Sequence[EpisodeScore]) -> Interval:
    """Bootstrap interval of the difference in `reward_per_step` on the *same* scenarios."""
    theirs = {score.episode: score for score in others}
    ours, paired = _reward_per_step(scores), _reward_per_step([theirs[s.episode] for s in scores])
    return bootstrap(lambda i: ours(i) - paired(i), len(scores))


def _reward_per_step(
    scores: Sequence[EpisodeScore],
) -> Callable[[NDArray[np.int64]], NDArray[np.float64]]:
    """Picks (R, E) of the episodes -> (R,) `reward_per_step` of each row."""
    rewards = np.array([score.reward for score in scores], np.float64)
    steps = np.array([score.steps for score in scores], np.float64)

    def of(picks: NDArray[np.int64]) -> NDArray[np.float64]:
        rates: NDArray[np.float64] = rewards[picks].sum(axis=1) / steps[picks].sum(axis=1)
        return rates

    return of


def success_gain(scores: Sequence[EpisodeScore], others: Sequence[EpisodeScore]) -> Interval:
    """Bootstrap interval of the difference in success rate on the *same* scenarios."""
    theirs = {score.episode: score.success for score in others}
    gains = np.array([float(s.success) - float(theirs[s.episode]) for s in scores])
    return bootstrap(lambda i: gains[i].mean(axis=1), len(gains))


def summarise(scores: Sequence[EpisodeScore]) -> dict[str, Any]:
    """The figures of one controller on one task, under the keys of ``eval.json``; of a sequence
    also ``parts``: part -> ``success_rate`` and ``success_ci95``."""
    plan_ms = np.concatenate([score.plan_ms for score in scores])
    parts = {name: _successes([score.parts[name] for score in scores]) for name in scores[0].parts}
    return {
        "episodes": len(scores),
        **_successes([score.success for score in scores]),
        "reward_mean": reward_per_step(scores),
        "reward_ci95": list(reward_interval(scores)),
        "plan_ms_p50": float(np.percentile(plan_ms, 50)),
        "plan_ms_p99": float(np.percentile(plan_ms, 99)),
        **({"parts": parts} if parts else {}),
    }


def _successes(each: Sequence[bool]) -> dict[str, Any]:
    count = sum(each)
    return {
        "success_rate": count / len(each),
        "success_ci95": list(wilson(count, len(each))),
    }
