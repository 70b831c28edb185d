"""The action that is sent each tick: from the newest usable plan, finite, rate-limited and bounded.

The limits are those of the data collection (`spec.ACTION_RATE_LIMIT` and the box [-1, 1]), so that
the robot stays within the training data. Numbers are checked *before* they are clamped: clamping
would turn an infinity into a full-speed command.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.spec import ACTION_DIM, ACTION_RATE_LIMIT

Array = NDArray[np.float64]

PATIENCE_TICKS: Final = 5  # consecutive rejected actions before the hands ease to neutral
HOLD_RATE: Final = 0.04  # box units per tick towards neutral: 1 unit in 1 s


class PlanBuffer:
    """Keeps the newest usable plan. A plan for tick t holds the actions of t .. t + N - 1, so that
    its later actions bridge plans that are late."""

    def __init__(self) -> None:
        self._plan: Array | None = None
        self._tick = -1
        self.misses = 0
        """Consecutive ticks without a plan in time."""

    def offer(self, tick: int, plan: NDArray[np.floating]) -> bool:
        """Take the plan (N, 7) made for ``tick``; false if it is not finite or not newer."""
        actions = np.asarray(plan, np.float64)
        if tick <= self._tick or not np.isfinite(actions).all():
            return False
        self._plan, self._tick = actions, tick
        return True

    def has(self, tick: int) -> bool:
        """Whether the plan for ``tick`` itself has arrived."""
        return self._tick == tick

    def action(self, tick: int) -> Array | None:
        """The action (7,) for ``tick``; call it once per tick. None: no plan covers the tick."""
        self.misses = 0 if self.has(tick) else self.misses + 1
        if self._plan is None:
            return None
        ahead = tick - self._tick
        return self._plan[ahead].copy() if 0 <= ahead < len(self._plan) else None


class SafetyFilter:
    """Filters the actions of E robots in step.

    An action that is not finite is rejected: the robot repeats its last action, and after
    `PATIENCE_TICKS` rejections in a row it eases to the neutral pose.
    """

    def __init__(self, rows: int = 1) -> None:
        self._last: Array = np.zeros((rows, ACTION_DIM))
        self._rejections: NDArray[np.int64] = np.zeros(rows, np.int64)

    def filter(self, planned: NDArray[np.floating]) -> Array:
        """Planned actions (E, 7) of any value -> actions that may be sent: in [-1, 1], at most the
        rate limit away from the last."""
        wanted = np.array(planned, np.float64)
        rejected = np.any(~np.isfinite(wanted), axis=1)
        self._rejections = np.where(rejected, self._rejections + 1, 0)
        fallback = np.where(self.holding[:, None], self._eased(), self._last)
        wanted[rejected] = fallback[rejected]
        change = np.clip(wanted - self._last, -ACTION_RATE_LIMIT, ACTION_RATE_LIMIT)
        self._last = np.clip(self._last + change, -1.0, 1.0)
        return self._last.copy()

    def ease(self) -> Array:
        """(E, 7) the next action towards the neutral pose."""
        self._last = self._eased()
        return self._last.copy()

    def repeat(self) -> Array:
        """(E, 7) the last action once more."""
        return self._last.copy()

    @property
    def holding(self) -> NDArray[np.bool_]:
        """(E,) robots that have lost their planner and ease to neutral."""
        holding: NDArray[np.bool_] = self._rejections > PATIENCE_TICKS
        return holding

    def _eased(self) -> Array:
        eased: Array = self._last - np.clip(self._last, -HOLD_RATE, HOLD_RATE)
        return eased
