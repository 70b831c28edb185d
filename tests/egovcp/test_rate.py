"""The fixed-rate loop keeps its grid and counts what it misses."""

from __future__ import annotations

import pytest

from egovcp.rate import FixedRate, LockstepClock, MonotonicClock

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
    assert rate.counters.ticks == 4
    assert rate.counters.overruns == 0


@pytest.mark.parametrize(("work_ms", "skipped"), [(41, 1), (80, 1), (81, 2), (200, 4)])
def test_an_overrun_resumes_on_the_grid_and_is_counted(work_ms: int, skipped: int) -> None:
    rate, clock = started()
    start = clock.now_ns()
    clock.advance(work_ms * MS)
    assert rate.wait() == (work_ms - 40) * MS
    assert (clock.now_ns() - start) % (40 * MS) == 0
    assert clock.now_ns() - start >= work_ms * MS
    assert (rate.counters.overruns, rate.counters.skipped) == (1, skipped)
    assert rate.counters.worst_lateness_ns == (work_ms - 40) * MS
    clock.advance(10 * MS)
    assert rate.wait() == 0, "the tick after an overrun has a whole period again"


def test_remaining_time_is_what_a_deadline_needs() -> None:
    rate, clock = started(hz=50)
    clock.advance(5 * MS)
    assert rate.remaining_ns() == 15 * MS
    clock.advance(20 * MS)
    assert rate.remaining_ns() == -5 * MS


def test_the_monotonic_clock_waits_at_least_as_long_as_asked() -> None:
    clock = MonotonicClock()
    deadline = clock.now_ns() + 2 * MS
    clock.sleep_until(deadline)
    assert clock.now_ns() >= deadline
    clock.sleep_until(deadline - 100 * MS)
