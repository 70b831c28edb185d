"""Which action to take when plans come late: the next one of the newest plan there is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class PlanBook:
    """Keeps the newest usable plan. A plan made for tick t knows the actions of t .. t + N - 1."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget every plan."""
        self._plan: Array | None = None
        self._made_for = -1
        self.misses = 0
        """Ticks in a row without a plan in time."""

    def offer(self, tick: int, plan: NDArray[np.floating]) -> bool:
        """Take the plan (N, 7) made for ``tick``; false if it is not all numbers, or not newer."""
        actions = np.asarray(plan, np.float64)
        if tick <= self._made_for or not np.isfinite(actions).all():
            return False
        self._plan, self._made_for = actions, tick
        return True

    def has(self, tick: int) -> bool:
        """Whether the plan for ``tick`` itself is there."""
        return self._made_for == tick

    def decide(self, tick: int) -> Array | None:
        """The action (7,) for ``tick``, once per tick; None: no plan reaches that far."""
        self.misses = 0 if self.has(tick) else self.misses + 1
        if self._plan is None:
            return None
        ahead = tick - self._made_for
        return self._plan[ahead].copy() if 0 <= ahead < len(self._plan) else None
