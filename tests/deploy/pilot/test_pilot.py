"""Age of a reading, measured from when its content last changed."""

from __future__ import annotations

import math

import numpy as np

from egovcp_deploy.pilot.pilot import Freshness


def test_the_age_is_infinite_before_the_first_reading() -> None:
    assert Freshness().age_s(10**9) == math.inf


def test_a_repeated_reading_ages() -> None:
    fresh, reading = Freshness(), np.arange(3.0)
    for k in range(6):
        fresh.update(k * 50_000_000, reading)
    assert fresh.age_s(250_000_000) == 0.25
    fresh.update(250_000_000, reading + 1e-12)
    assert fresh.age_s(250_000_000) == 0.0


def test_missing_and_non_finite_readings_are_ignored() -> None:
    fresh = Freshness()
    fresh.update(0, np.zeros(3))
    fresh.update(100_000_000, np.array([1.0, math.nan, 0.0]))
    fresh.update(150_000_000, None)
    assert fresh.age_s(200_000_000) == 0.2


def test_empty_images_may_repeat_with_a_new_time_stamp() -> None:
    fresh, empty = Freshness(), np.zeros((48, 64), np.uint16)
    fresh.update(10**9, empty)
    fresh.update(2 * 10**9, empty)
    assert fresh.age_s(2 * 10**9) == 0.0
    fresh.update(2 * 10**9, empty)
    assert fresh.age_s(3 * 10**9) == 1.0
