"""A fixed-rate loop on an injectable clock."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

NS_PER_S = 1_000_000_000


class Clock(Protocol):
    """A monotonic clock that can be waited on."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary start."""

    def sleep_until(self, deadline_ns: int) -> None:
        """Return at ``deadline_ns``, or at once if it has passed."""


class MonotonicClock:
    """The monotonic clock of the machine, independent of the wall clock."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary start."""
        return time.monotonic_ns()

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleep until ``deadline_ns``."""
        remaining = deadline_ns - time.monotonic_ns()
        if remaining > 0:
            time.sleep(remaining / NS_PER_S)


@dataclass
class FixedRate:
    """Runs a loop at ``hz`` on a grid of deadlines that does not drift.

    Tick k has the period [k, k + 1) / hz after `start`. After an overrun the loop resumes at the
    next whole period, without a burst of ticks, so that a robot never receives several commands at
    once::

        rate = FixedRate(25, clock)
        rate.start()
        while running:
            work()
            rate.wait()
    """

    hz: float
    clock: Clock
    _next_ns: int = 0

    @property
    def period_ns(self) -> int:
        return round(NS_PER_S / self.hz)

    def start(self) -> None:
        """Start the first period now."""
        self._next_ns = self.clock.now_ns() + self.period_ns

    def wait(self) -> int:
        """Sleep until the end of the period; returns the overrun, ns."""
        late = max(0, self.clock.now_ns() - self._next_ns)
        missed = -(-late // self.period_ns)  # whole periods, rounded up
        self._next_ns += missed * self.period_ns
        self.clock.sleep_until(self._next_ns)
        self._next_ns += self.period_ns
        return late


class RateLimiter:
    """Allows an action at most once per period.

    Args:
        period_s: shortest time between two actions, s.
    """

    def __init__(self, period_s: float) -> None:
        self._period_ns = round(period_s * NS_PER_S)
        self._next_ns: int | None = None

    def ready(self, now_ns: int) -> bool:
        """Whether the action may be done now; if so, the next period begins."""
        if self._next_ns is not None and now_ns < self._next_ns:
            return False
        self._next_ns = now_ns + self._period_ns
        return True
