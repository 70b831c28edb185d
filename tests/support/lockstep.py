"""Simulated time: `LockstepClock`, and `DelayedPlanner`, whose plans take some of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from egovcp_deploy.pilot.planner import BACKLOG, ObservationMessage, PlanMessage, PlannerRunner


@dataclass
class LockstepClock:
    """Simulated time that changes only by `sleep_until` and `advance`."""

    time_ns: int = 0

    def now_ns(self) -> int:
        """Nanoseconds of simulated time."""
        return self.time_ns

    def sleep_until(self, deadline_ns: int) -> None:
        """Jump to ``deadline_ns`` unless it has passed."""
        self.time_ns = max(self.time_ns, deadline_ns)

    def advance(self, duration_ns: int) -> None:
        self.time_ns += duration_ns


class DelayedPlanner:
    """A `PlannerClient` in simulated time. ``delay_ns`` is the planning time by tick; observations
    wait while the planner is busy."""

    alive = True

    def __init__(self, runner: PlannerRunner, delay_ns: Callable[[int], int]) -> None:
        self._runner = runner
        self._delay_ns = delay_ns
        self._waiting: deque[ObservationMessage] = deque(maxlen=BACKLOG)
        self._ready: tuple[int, PlanMessage] | None = None

    def submit(self, observation: ObservationMessage) -> bool:
        """Send o_t; an idle planner begins at once."""
        self._waiting.append(observation)
        self._begin(observation.time_ns)
        return True

    def poll(self, now_ns: int) -> list[PlanMessage]:
        """Plans that are due by ``now_ns``."""
        plans = []
        while self._ready is not None and self._ready[0] <= now_ns:
            ready_ns, plan = self._ready
            plans.append(plan)
            self._ready = None
            self._begin(ready_ns)
        return plans

    def _begin(self, now_ns: int) -> None:
        if self._ready is None and self._waiting:
            plan = self._runner.decode(self._runner.plan(list(self._waiting)))
            self._waiting.clear()
            self._ready = (now_ns + self._delay_ns(plan.tick), plan)
