"""Rate, jitter and loss from times of arrival."""

from __future__ import annotations

import pytest

from egovcp_deploy.robots.arrivals import Arrivals

MS = 1_000_000


def filled(times_ms: list[float], numbered: bool = False) -> Arrivals:
    arrivals = Arrivals(numbered)
    for time in times_ms:
        arrivals.arrived(round(time * MS))
    return arrivals


def test_a_steady_stream() -> None:
    stats = filled([5.0 * k for k in range(1, 401)]).stats(2000 * MS)
    assert stats.rate_hz == pytest.approx(200.0)
    assert (stats.jitter_ms, stats.gap_ms, stats.lost) == (0.0, 5.0, 0.0)


def test_only_the_window_counts() -> None:
    arrivals = filled([5.0 * k for k in range(1, 201)])
    arrivals.lost(1 * MS, 500)
    assert arrivals.stats(2500 * MS).lost == 1.0, "nothing in the last second"
    assert arrivals.stats(2500 * MS).gap_ms == 1000.0
    assert arrivals.stats(2000 * MS, window_s=1.5).lost == 0.0


def test_silence_is_a_gap() -> None:
    assert filled([5.0 * k for k in range(1, 101)]).stats(700 * MS).gap_ms == 200.0


def test_missing_messages_are_estimated_from_intervals() -> None:
    times = [5.0 * k for k in range(1, 201) if k % 10]  # every tenth is missing
    assert filled(times).stats(1000 * MS).lost == pytest.approx(0.1, abs=0.01)


def test_messages_that_are_not_usable_are_counted_once_although_they_leave_gaps() -> None:
    arrivals = filled([5.0 * k for k in range(1, 201) if k % 10])
    for k in range(10, 201, 10):
        arrivals.lost(round(5.0 * k * MS))
    assert arrivals.stats(1000 * MS).lost == pytest.approx(0.1, abs=0.01)


def test_numbered_messages_are_counted_not_estimated() -> None:
    arrivals = filled([5.0 * k for k in range(1, 201) if k % 10], numbered=True)
    assert arrivals.stats(1000 * MS).lost == 0.0
    arrivals.lost(900 * MS, 20)
    assert arrivals.stats(1000 * MS).lost == pytest.approx(20 / 200)


def test_jitter_is_how_far_intervals_are_from_their_median() -> None:
    times = [5.0 * k + (1.0 if k % 2 else 0.0) for k in range(1, 201)]
    assert filled(times).stats(1000 * MS).jitter_ms == pytest.approx(2.0)
