"""The fixed-rate loop keeps its grid and returns its overruns."""

from __future__ import annotations

import pytest

from egovcp.rate import FixedRate, MonotonicClock
from tests.support.lockstep import LockstepClock

MS = 1_000_000


def started(hz: float = 25) -> tuple[FixedRate, LockstepClock]:
    clock = LockstepClock(time_ns=7 * MS)
    rate = FixedRate(hz, clock)
    rate.start()
    return rate, clock


def test_ticks_start_on_a_grid_whatever_the_work_within_a_period() -> None:
    rate, clock = started()
    starts = []
    for work_ms in (0, 39, 1, 20):
        starts.append(clock.now_ns())
        clock.advance(work_ms * MS)
        assert rate.wait() == 0
    assert [s - starts[0] for s in starts] == [0, 40 * MS, 80 * MS, 120 * MS]


@pytest.mark.parametrize("work_ms", [41, 80, 81, 200])
def test_an_overrun_resumes_on_the_grid_and_is_returned(work_ms: int) -> None:
    rate, clock = started()
    start = clock.now_ns()
    clock.advance(work_ms * MS)
    assert rate.wait() == (work_ms - 40) * MS
    assert (clock.now_ns() - start) % (40 * MS) == 0
    assert clock.now_ns() - start >= work_ms * MS
    clock.advance(10 * MS)
    assert rate.wait() == 0, "the tick after an overrun has a whole period again"


def test_the_monotonic_clock_waits_at_least_as_long_as_asked() -> None:
    clock = MonotonicClock()
    deadline = clock.now_ns() + 2 * MS
    clock.sleep_until(deadline)
    assert clock.now_ns() >= deadline
    clock.sleep_until(deadline - 100 * MS)
