"""Options of tasks and of their episodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from egovcp.bounds import OutOfBounds, bounded

Range = tuple[float, float]
#: Longest episode, planner ticks.
MAX_TICKS: Final = 10_000
#: Greatest coefficient of a reward term; larger ones lose the others in float32.
MAX_REWARD: Final = 1000


@dataclass(frozen=True)
class EpisodeConfig:
    """Length of an episode and the time of its event, in planner ticks (G1: 40 ms).

    Raises:
        UsageError: the event may start after the end of the episode.
    """

    ticks: int = bounded(150, least=1, most=MAX_TICKS)
    """Time limit, planner ticks; reaching it truncates the episode."""
    event_ticks: tuple[int, int] = bounded((20, 60), least=0, most=MAX_TICKS)
    """First and last tick at which the event may start, such as a throw or a push; less than
    `ticks`."""
    empty_probability: float = bounded(0.1, least=0, most=1)
    """Share of episodes without an event, from which resting is learned."""

    def __post_init__(self) -> None:
        if self.event_ticks[1] >= self.ticks:
            raise OutOfBounds("event_ticks", self.event_ticks, f"less than ticks={self.ticks}")


@dataclass(frozen=True)
class TaskConfig:
    """Options of a task; a subclass adds the task's own."""

    fall_cost: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, at a fall."""
