"""Options of tasks and of their episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from egovcp.bounds import bounded

Range = tuple[float, float]
#: Longest episode, planner ticks.
MAX_TICKS: Final = 10_000
#: Greatest coefficient of a reward term; larger ones lose the others in float32.
MAX_REWARD: Final = 1000


@dataclass(frozen=True)
class EpisodeConfig:
    """Length of an episode and the time of its event, in planner ticks (G1: 40 ms)."""

    ticks: int = bounded(150, least=1, most=MAX_TICKS)
    """Time limit, planner ticks; reaching it truncates the episode."""
    event_ticks: tuple[int, int] = bounded((20, 60), least=0, most=MAX_TICKS)
    """First and last tick at which the event may start, such as a throw or a push."""
    empty_probability: float = bounded(0.1, least=0, most=1)
    """Share of episodes without an event, from which resting is learned."""


@dataclass(frozen=True)
class TaskConfig:
    """Options of a task; a subclass adds the task's own."""

    fall_cost: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, at a fall."""
