"""A fixed-rate loop on an injectable clock, with counters that say when it ran late.

Hardware and the real-time simulator run on `MonotonicClock`; lock-step simulation and the
tests run on `LockstepClock`, where time passes only by waiting, so nothing depends on the
speed of the machine.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Protocol

NS_PER_S = 1_000_000_000


class Clock(Protocol):
    """A clock that never goes backwards and that can be waited on."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary start."""
        ...

    def sleep_until(self, deadline_ns: int) -> None:
        """Return at ``deadline_ns``, or at once if it has passed."""
        ...


class MonotonicClock:
    """The machine's monotonic clock: jumps of the wall clock do not touch it."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary start."""
        return time.monotonic_ns()

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleep until ``deadline_ns``; the operating system may wake us a little later."""
        remaining = deadline_ns - time.monotonic_ns()
        if remaining > 0:
            time.sleep(remaining / NS_PER_S)


@dataclass
class LockstepClock:
    """Time that passes only by waiting or by `advance`: computing takes no time at all."""

    time_ns: int = 0

    def now_ns(self) -> int:
        """Nanoseconds of simulated time."""
        return self.time_ns

    def sleep_until(self, deadline_ns: int) -> None:
        """Jump to ``deadline_ns`` unless it has passed."""
        self.time_ns = max(self.time_ns, deadline_ns)

    def advance(self, duration_ns: int) -> None:
        """Let ``duration_ns`` pass, as if work had taken that long."""
        self.time_ns += duration_ns


@dataclass
class RateCounters:
    """How well a loop kept its rate."""

    ticks: int = 0
    """Ticks completed."""
    overruns: int = 0
    """Ticks whose work ended after their period."""
    skipped: int = 0
    """Periods in which no tick started, because an earlier one was still busy."""
    worst_lateness_ns: int = 0
    """Longest time by which work passed the end of its period."""


@dataclass
class FixedRate:
    """Paces a loop at ``hz`` on a grid of deadlines that does not drift.

    Tick k owns the period [k, k+1) / hz after `start`. Work that runs past its period is an
    overrun; the loop then resumes at the next whole period, never in a burst to catch up:
    a robot must not receive several commands at once::

        rate = FixedRate(25, clock)
        rate.start()
        while running:
            work()
            rate.wait()
    """

    hz: float
    clock: Clock
    counters: RateCounters = field(default_factory=RateCounters)
    _next_ns: int = 0

    @property
    def period_ns(self) -> int:
        """Length of one tick in nanoseconds."""
        return round(NS_PER_S / self.hz)

    def start(self) -> None:
        """Begin the first period now; counters keep their values."""
        self._next_ns = self.clock.now_ns() + self.period_ns

    def remaining_ns(self) -> int:
        """Time left in the current period; negative once it has been overrun."""
        return self._next_ns - self.clock.now_ns()

    def wait(self) -> int:
        """Sleep to the end of the period; return by how many ns the work had passed it (or 0)."""
        late = max(0, -self.remaining_ns())
        self._count(late)
        missed = -(-late // self.period_ns)  # whole periods to let go, rounded up
        self._next_ns += missed * self.period_ns
        self.clock.sleep_until(self._next_ns)
        self._next_ns += self.period_ns
        return late

    def _count(self, late: int) -> None:
        self.counters.ticks += 1
        self.counters.overruns += late > 0
        self.counters.skipped += -(-late // self.period_ns)
        self.counters.worst_lateness_ns = max(self.counters.worst_lateness_ns, late)
