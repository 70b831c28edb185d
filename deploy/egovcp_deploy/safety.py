"""The last word on every action before it is sent: finite, gentle, inside the box.

The limits are those of the data collection (`spec.ACTION_RATE_LIMIT` and the box [-1, 1]),
so the robot never leaves what the policy was trained on. Numbers are checked *before* they
are clamped: clamping would turn an infinity into a full-speed command.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovcp.spec import ACTION_DIM, ACTION_RATE_LIMIT

Array = NDArray[np.float64]

PATIENCE_TICKS: Final = 5  # rejected plans in a row before the robot goes to hold
HOLD_RATE: Final = 0.04  # box units per tick while hands ease to neutral: 1 unit in 1 s


class Filtered(NamedTuple):
    """What may be sent."""

    action: Array
    """(E, 7) in [-1, 1], at most the rate limit away from the last."""
    rejected: NDArray[np.bool_]
    """(E,) rows whose planned action was not finite and was replaced."""


class SafetyFilter:
    """Filters the actions of E robots in step; remembers what each was sent last.

    A plan that is not finite is rejected: the robot repeats its last action, and after
    `PATIENCE_TICKS` rejections in a row it holds, easing to the neutral pose.
    """

    def __init__(self, rows: int = 1) -> None:
        self._last: Array = np.zeros((rows, ACTION_DIM))
        self._misses: NDArray[np.int64] = np.zeros(rows, np.int64)

    def reset(self) -> None:
        """All robots stand in the neutral pose again."""
        self._last[:] = 0.0
        self._misses[:] = 0

    def filter(self, planned: NDArray[np.floating]) -> Filtered:
        """Planned actions (E, 7) of any value -> actions that may be sent."""
        wanted = np.array(planned, np.float64)
        rejected = np.any(~np.isfinite(wanted), axis=1)
        self._misses = np.where(rejected, self._misses + 1, 0)
        wanted[rejected] = self._fallback()[rejected]
        change = np.clip(wanted - self._last, -ACTION_RATE_LIMIT, ACTION_RATE_LIMIT)
        self._last = np.clip(self._last + change, -1.0, 1.0)
        return Filtered(self._last.copy(), rejected)

    def ease(self) -> Array:
        """(E, 7) the next action on every robot's way to the neutral pose, as sent."""
        self._last = self._eased()
        return self._last.copy()

    def repeat(self) -> Array:
        """(E, 7) the last action once more, as sent."""
        return self._last.copy()

    @property
    def holding(self) -> NDArray[np.bool_]:
        """(E,) robots that have lost their planner and ease to neutral."""
        holding: NDArray[np.bool_] = self._misses > PATIENCE_TICKS
        return holding

    def _fallback(self) -> Array:
        """(E, 7) the last action, or from hold on a small step from it towards neutral."""
        return np.where(self.holding[:, None], self._eased(), self._last)

    def _eased(self) -> Array:
        """(E, 7) a small step from the last action towards neutral."""
        eased: Array = self._last - np.clip(self._last, -HOLD_RATE, HOLD_RATE)
        return eased
