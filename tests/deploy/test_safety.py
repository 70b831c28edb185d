"""Whatever the planner says, what is sent is finite, gentle and inside the box."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp.spec import ACTION_DIM, ACTION_RATE_LIMIT
from egovcp_deploy.safety import HOLD_RATE, PATIENCE_TICKS, SafetyFilter

SPECIALS = np.array([np.nan, np.inf, -np.inf, 1e308, -1e308, 0.0, 1.0, -1.0, 1.5])


def test_fuzzed_actions_never_leave_the_envelope() -> None:
    rng = np.random.default_rng(0)
    safety, last = SafetyFilter(rows=100), np.zeros((100, ACTION_DIM))
    for _ in range(1000):  # 100 000 actions
        planned = rng.normal(0, 2, last.shape)
        odd = rng.random(last.shape) < 0.1
        planned[odd] = rng.choice(SPECIALS, int(odd.sum()))
        sent, rejected = safety.filter(planned)
        assert np.isfinite(sent).all()
        assert np.abs(sent).max() <= 1.0
        assert np.abs(sent - last).max() <= ACTION_RATE_LIMIT + 1e-12
        np.testing.assert_array_equal(rejected, ~np.isfinite(planned).all(axis=1))
        last = sent


def test_a_safe_action_passes_unchanged() -> None:
    safety = SafetyFilter()
    for k in range(1, 4):
        planned = np.full((1, ACTION_DIM), 0.3 * k)
        np.testing.assert_allclose(safety.filter(planned).action, planned)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_single_bad_number_rejects_the_whole_plan_instead_of_being_clamped(
    value: float,
) -> None:
    safety = SafetyFilter()
    good = safety.filter(np.full((1, ACTION_DIM), 0.2)).action
    bad = np.full((1, ACTION_DIM), 0.5)
    bad[0, 3] = value
    sent, rejected = safety.filter(bad)
    assert rejected.tolist() == [True]
    np.testing.assert_array_equal(sent, good)


def test_losing_the_planner_ends_in_the_neutral_pose_gently() -> None:
    safety = SafetyFilter()
    for _ in range(4):
        last = safety.filter(np.ones((1, ACTION_DIM))).action
    nothing = np.full((1, ACTION_DIM), np.nan)
    for _ in range(PATIENCE_TICKS):
        np.testing.assert_array_equal(safety.filter(nothing).action, last)
    assert not safety.holding[0]
    for _ in range(40):
        sent = safety.filter(nothing).action
        assert np.abs(sent - last).max() <= HOLD_RATE + 1e-12
        last = sent
    assert safety.holding[0]
    np.testing.assert_allclose(last, 0.0, atol=1e-12)


def test_one_good_plan_ends_the_hold_and_rows_do_not_touch_each_other() -> None:
    safety = SafetyFilter(rows=2)
    mixed = np.stack([np.full(ACTION_DIM, np.nan), np.full(ACTION_DIM, 0.1)])
    for _ in range(PATIENCE_TICKS + 2):
        safety.filter(mixed)
    assert safety.holding.tolist() == [True, False]
    safety.filter(np.zeros((2, ACTION_DIM)))
    assert safety.holding.tolist() == [False, False]


def test_reset_forgets() -> None:
    safety = SafetyFilter()
    safety.filter(np.ones((1, ACTION_DIM)))
    safety.reset()
    sent = safety.filter(np.ones((1, ACTION_DIM))).action
    np.testing.assert_allclose(sent, ACTION_RATE_LIMIT)
