"""The operator's base velocity: bounded, ramped, and zero when the operator falls silent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STILL: Final = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class VelocityLimits:
    """What an operator may ask for; vx, vy (m/s), yaw rate (rad/s) in the heading frame."""

    low: tuple[float, float, float] = (-0.3, -0.2, -0.5)
    high: tuple[float, float, float] = (0.6, 0.2, 0.5)
    ramp: tuple[float, float, float] = (1.0, 1.0, 2.0)
    """Greatest change per second."""
    timeout_s: float = 0.5
    """A wish older than this counts as zero, s."""


class VelocityCommand:
    """Turns wishes, which come when they come, into one command per control tick."""

    def __init__(self, limits: VelocityLimits | None = None) -> None:
        self.limits = limits or VelocityLimits()
        self.reset()

    def reset(self) -> None:
        """Stand still, and forget every wish."""
        self._wish: Array = np.zeros(3)
        self._wished_ns: int | None = None
        self._command: Array = np.zeros(3)
        self._last_ns: int | None = None

    def wish(self, time_ns: int, velocity: NDArray[np.floating] | tuple[float, ...]) -> None:
        """The operator asks for ``velocity`` (3,); one that is not all numbers is ignored."""
        wish = np.asarray(velocity, np.float64)
        if wish.shape == (3,) and np.isfinite(wish).all():
            self._wish = np.clip(wish, self.limits.low, self.limits.high)
            self._wished_ns = time_ns

    def at(self, time_ns: int, allowed: bool = True) -> Array:
        """(3,) the velocity to command now; ``allowed``: whether the robot may move at all."""
        silent = self._wished_ns is None or (
            time_ns - self._wished_ns > self.limits.timeout_s * 1e9
        )
        target = np.zeros(3) if silent or not allowed else self._wish
        elapsed = 0.0 if self._last_ns is None else max(0.0, (time_ns - self._last_ns) / 1e9)
        step = np.asarray(self.limits.ramp) * elapsed
        self._command = self._command + np.clip(target - self._command, -step, step)
        self._last_ns = time_ns
        return self._command.copy()
