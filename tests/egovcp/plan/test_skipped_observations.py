"""An observation that is not finite is skipped: the policy predicts through it and recovers."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.plan import Policy, PolicyStep
from egovcp.testing import toy_model
from tests.support.worlds import plain_planner

CONFIG = plain_planner(samples=32, elites=4, iterations=1, backend="float32")
ROBOTS, TICKS, BAD_TICK, BAD_ROBOT = 3, 5, 2, 1
GRAVITY = spec.STATE_SLICES["projected_gravity"]

type Observation = tuple[NDArray[np.uint16], NDArray[np.float32]]
type Damage = Callable[[NDArray[np.uint16], NDArray[np.float32]], None]


def _observation(tick: int) -> Observation:
    rng = np.random.default_rng(tick)
    depth = rng.integers(300, 5000, (ROBOTS, spec.DEPTH_ROWS, spec.DEPTH_COLS))
    state = rng.normal(size=(ROBOTS, spec.STATE_DIM))
    return depth.astype(np.uint16), state.astype(np.float32)


def _play(damage: Damage | None, ticks: range = range(TICKS)) -> tuple[Policy, list[PolicyStep]]:
    """Act on every tick, with the observation of one robot at one tick damaged."""
    policy, steps = Policy(toy_model(), CONFIG, ROBOTS), list[PolicyStep]()
    for tick in ticks:
        depth, state = _observation(tick)
        if damage is not None and tick == BAD_TICK:
            damage(depth, state)
        steps.append(policy.act(depth, state))
        policy.advance(steps[-1].action)
    return policy, steps


def _set_state(value: float, index: int | slice) -> Damage:
    def damage(depth: NDArray[np.uint16], state: NDArray[np.float32]) -> None:
        state[BAD_ROBOT, index] = value

    return damage


SKIPPED = {
    "one NaN": _set_state(np.nan, 20),
    "all NaN": _set_state(np.nan, slice(None)),
    "infinite gravity": _set_state(np.inf, GRAVITY),
    "negative infinity": _set_state(-np.inf, 73),
    "largest float": _set_state(3e38, GRAVITY),
    "an impossible joint": _set_state(1e6, 30),
}


@pytest.mark.parametrize("name", SKIPPED)
def test_the_robot_recovers_and_the_skip_is_reported(name: str) -> None:
    policy, steps = _play(SKIPPED[name])
    for tick, step in enumerate(steps):
        expected = [tick == BAD_TICK and robot == BAD_ROBOT for robot in range(ROBOTS)]
        assert step.skipped.tolist() == expected
        for array in (step.action, step.value, step.termination, step.plan):
            assert np.isfinite(array).all()
    assert all(part.isfinite().all() for part in policy.carry if part is not None)
    plans = [step.plan[BAD_ROBOT] for step in steps[BAD_TICK + 1 :]]
    assert not np.array_equal(*plans), "the policy is frozen"


@pytest.mark.parametrize("name", SKIPPED)
def test_other_robots_act_as_if_nothing_had_happened(name: str) -> None:
    _, steps = _play(SKIPPED[name])
    _, undamaged = _play(None)
    others = [robot for robot in range(ROBOTS) if robot != BAD_ROBOT]
    for step, expected in zip(steps, undamaged, strict=True):
        np.testing.assert_array_equal(step.plan[others], expected.plan[others])


def test_the_prior_predicts_the_state_of_a_skipped_tick() -> None:
    policy, _ = _play(None, range(BAD_TICK))
    before, sent = policy.carry, policy._sent
    depth, state = _observation(BAD_TICK)
    state[:] = np.nan
    policy.observe(depth, state)
    with torch.inference_mode():
        expected = policy.model.imagine(before, sent)
    for found, part in zip(policy.carry, expected, strict=True):
        assert torch.equal(found, part)


def test_an_episode_that_begins_with_a_skip_starts_at_its_first_usable_observation() -> None:
    policy, expected = (Policy(toy_model(), CONFIG, ROBOTS) for _ in range(2))
    depth, state = _observation(0)
    step = policy.act(depth, np.full_like(state, np.nan))
    assert np.isfinite(step.value).all()
    policy.advance(step.action)
    policy.observe(depth, state)
    expected.observe(depth, state)
    for found, part in zip(policy.carry, expected.carry, strict=True):
        torch.testing.assert_close(found, part)


def _full_scale(depth: NDArray[np.uint16], state: NDArray[np.float32]) -> None:
    depth[BAD_ROBOT] = np.iinfo(np.uint16).max


def _fast_joints(depth: NDArray[np.uint16], state: NDArray[np.float32]) -> None:
    state[BAD_ROBOT] = 999.0


@pytest.mark.parametrize("damage", [_full_scale, _fast_joints])
def test_impossible_finite_values_do_not_poison_the_carry(damage: Damage) -> None:
    _, steps = _play(damage, range(20))
    _, undamaged = _play(None, range(20))
    assert all(np.isfinite(step.value).all() for step in steps)
    early, late = (
        np.abs(steps[tick].value[BAD_ROBOT] - undamaged[tick].value[BAD_ROBOT])
        for tick in (BAD_TICK, 19)
    )
    assert late < 0.2 * early


def test_depth_that_is_not_finite_is_invalid_depth() -> None:
    with_holes, with_nan = (Policy(toy_model(), CONFIG, ROBOTS) for _ in range(2))
    depth, state = _observation(0)
    depth[:, 10:20] = 0
    floating = np.where(depth == 0, np.nan, depth.astype(np.float32))
    expected, found = with_holes.act(depth, state), with_nan.act(floating, state)
    np.testing.assert_array_equal(found.plan, expected.plan)
    assert not found.skipped.any()


def test_an_action_that_is_not_finite_was_not_sent() -> None:
    policy, _ = _play(None, range(1))
    with pytest.raises(UsageError, match="not finite"):
        policy.advance(np.full((ROBOTS, spec.ACTION_DIM), np.nan))


def test_observations_of_another_shape_are_refused_with_what_was_expected() -> None:
    policy = Policy(toy_model(), CONFIG, ROBOTS)
    depth, state = _observation(0)
    for wrong in ((depth, state[:, :73]), (depth[:2], state), (depth[:, :, :32], state)):
        with pytest.raises(UsageError, match=r"expected \(3, 48, 64\) and \(3, 74\)"):
            policy.act(*wrong)


def test_warming_up_changes_no_plan() -> None:
    cold, warm = (Policy(toy_model(), CONFIG, ROBOTS, seed=4) for _ in range(2))
    warm.warm_up()
    for tick in range(2):
        expected, found = (policy.act(*_observation(tick)) for policy in (cold, warm))
        np.testing.assert_array_equal(found.plan, expected.plan)
        cold.advance(expected.action)
        warm.advance(found.action)
