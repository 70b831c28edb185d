"""Sent actions are finite, rate limited and in the box; late plans are bridged by earlier ones."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp.spec import ACTION_DIM, ACTION_RATE_LIMIT
from egovcp_deploy.pilot.pilot import HOLD_RATE, MAX_REPEATS, PlanBuffer, SafetyFilter

SPECIALS = np.array([np.nan, np.inf, -np.inf, 1e308, -1e308, 0.0, 1.0, -1.0, 1.5])


def test_fuzzed_actions_never_leave_the_envelope() -> None:
    rng = np.random.default_rng(0)
    safety, last = SafetyFilter(num_envs=100), np.zeros((100, ACTION_DIM))
    for _ in range(1000):  # 100 000 actions
        planned = rng.normal(0, 2, last.shape)
        odd = rng.random(last.shape) < 0.1
        planned[odd] = rng.choice(SPECIALS, int(odd.sum()))
        sent = safety.filter(planned)
        assert np.isfinite(sent).all()
        assert np.abs(sent).max() <= 1.0
        assert np.abs(sent - last).max() <= ACTION_RATE_LIMIT + 1e-12
        rejected = ~np.isfinite(planned).all(axis=1)
        eased = last - np.clip(last, -HOLD_RATE, HOLD_RATE)
        fallback = np.where(safety.holding[:, None], eased, last)
        np.testing.assert_array_equal(sent[rejected], fallback[rejected])
        last = sent


def test_a_safe_action_passes_unchanged() -> None:
    safety = SafetyFilter()
    for k in range(1, 4):
        planned = np.full((1, ACTION_DIM), 0.3 * k)
        np.testing.assert_allclose(safety.filter(planned), planned)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_one_bad_number_rejects_the_whole_action(
    value: float,
) -> None:
    safety = SafetyFilter()
    good = safety.filter(np.full((1, ACTION_DIM), 0.2))
    bad = np.full((1, ACTION_DIM), 0.5)
    bad[0, 3] = value
    np.testing.assert_array_equal(safety.filter(bad), good)


def test_without_a_planner_the_hands_ease_to_neutral() -> None:
    safety = SafetyFilter()
    for _ in range(4):
        last = safety.filter(np.ones((1, ACTION_DIM)))
    nothing = np.full((1, ACTION_DIM), np.nan)
    for _ in range(MAX_REPEATS):
        np.testing.assert_array_equal(safety.filter(nothing), last)
    assert not safety.holding[0]
    for _ in range(40):
        sent = safety.filter(nothing)
        assert np.abs(sent - last).max() <= HOLD_RATE + 1e-12
        last = sent
    assert safety.holding[0]
    np.testing.assert_allclose(last, 0.0, atol=1e-12)


def test_one_good_action_ends_the_hold_and_rows_are_independent() -> None:
    safety = SafetyFilter(num_envs=2)
    mixed = np.stack([np.full(ACTION_DIM, np.nan), np.full(ACTION_DIM, 0.1)])
    for _ in range(MAX_REPEATS + 2):
        safety.filter(mixed)
    assert safety.holding.tolist() == [True, False]
    safety.filter(np.zeros((2, ACTION_DIM)))
    assert safety.holding.tolist() == [False, False]


def plan(first: float) -> np.ndarray:
    """Steps 0 .. 3 hold first + 0.1 step."""
    return np.repeat((first + 0.1 * np.arange(4))[:, None], 7, axis=1)


def test_a_plan_in_time_gives_its_first_action() -> None:
    buffer = PlanBuffer()
    assert buffer.offer(0, plan(0.0))
    assert buffer.action(0)[0] == 0.0
    assert buffer.misses == 0


def test_without_a_new_plan_the_old_one_is_used_to_its_end() -> None:
    buffer = PlanBuffer()
    buffer.offer(0, plan(0.0))
    taken = [buffer.action(tick) for tick in range(6)]
    np.testing.assert_allclose([a[0] for a in taken[:4]], [0.0, 0.1, 0.2, 0.3])
    assert taken[4] is None
    assert taken[5] is None
    assert buffer.misses == 5


def test_a_late_plan_starts_at_its_second_action() -> None:
    buffer = PlanBuffer()
    buffer.action(0)
    buffer.offer(0, plan(0.5))
    assert buffer.action(1)[0] == pytest.approx(0.6)
    assert buffer.misses == 2


def test_an_older_plan_does_not_replace_a_newer() -> None:
    buffer = PlanBuffer()
    buffer.offer(3, plan(0.3))
    assert not buffer.offer(2, plan(0.9))
    assert buffer.action(3)[0] == pytest.approx(0.3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_plan_with_a_bad_number_anywhere_is_refused(bad: float) -> None:
    buffer, broken = PlanBuffer(), plan(0.5)
    buffer.offer(0, plan(0.0))
    broken[3, 6] = bad
    assert not buffer.offer(1, broken)
    assert buffer.action(1)[0] == pytest.approx(0.1)
    assert buffer.misses == 1
