"""Observations that a policy skips because they are impossible, and inputs that it refuses."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.plan import PlannerConfig, Policy, PolicyStep
from egovcp.robot_spec import G1
from egovcp.testing import toy_model
from tests.support.worlds import plain_planner

A = spec.ACTION_DIM
FAST_CONFIG = plain_planner(samples=32, elites=4, iterations=1, backend="float32")
ROBOTS, STEPS, BAD_STEP, BAD_ROBOT = 3, 5, 2, 1
GRAVITY = spec.STATE_SLICES["projected_gravity"]

type Observation = tuple[NDArray[np.uint16], NDArray[np.float32]]
type Damage = Callable[[NDArray[np.uint16], NDArray[np.float32]], None]


def _observation(tick: int) -> Observation:
    rng = np.random.default_rng(tick)
    depth = rng.integers(300, 5000, (ROBOTS, spec.DEPTH_ROWS, spec.DEPTH_COLS))
    state = rng.normal(size=(ROBOTS, spec.STATE_DIM))
    return depth.astype(np.uint16), state.astype(np.float32)


def _play(
    damage: Damage | None, ticks: range = range(STEPS), config: PlannerConfig = FAST_CONFIG
) -> tuple[Policy, list[PolicyStep]]:
    """Act on every step, with the observation of one robot at one step damaged."""
    policy, steps = Policy(toy_model(), config, ROBOTS), list[PolicyStep]()
    for tick in ticks:
        depth, state = _observation(tick)
        if damage is not None and tick == BAD_STEP:
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
        expected = [tick == BAD_STEP and robot == BAD_ROBOT for robot in range(ROBOTS)]
        assert step.skipped.tolist() == expected
        for array in (step.action, step.value, step.termination, step.plan):
            assert np.isfinite(array).all()
    assert all(part.isfinite().all() for part in policy.carry if part is not None)
    plans = [step.plan[BAD_ROBOT] for step in steps[BAD_STEP + 1 :]]
    assert not np.array_equal(*plans), "the policy is frozen"


@pytest.mark.parametrize("name", SKIPPED)
def test_skipped_observation_does_not_affect_other_robots(name: str) -> None:
    _, steps = _play(SKIPPED[name])
    _, undamaged = _play(None)
    others = [robot for robot in range(ROBOTS) if robot != BAD_ROBOT]
    for step, expected in zip(steps, undamaged, strict=True):
        np.testing.assert_array_equal(step.plan[others], expected.plan[others])


def test_prior_predicts_the_state_of_a_skipped_step() -> None:
    policy, _ = _play(None, range(BAD_STEP))
    before, sent = policy.carry, policy._sent
    depth, state = _observation(BAD_STEP)
    state[:] = np.nan
    policy.observe(depth, state)
    with torch.inference_mode():
        expected = policy.model.imagine(before, sent)
    torch.testing.assert_close(policy.carry, expected)


def test_an_episode_that_begins_with_a_skip_starts_at_its_first_usable_observation() -> None:
    policy, expected = (Policy(toy_model(), FAST_CONFIG, ROBOTS) for _ in range(2))
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
def test_impossible_finite_values_do_not_enter_the_carry(damage: Damage) -> None:
    config = dataclasses.replace(FAST_CONFIG, mirror=False)  # one state, so one influence
    _, steps = _play(damage, range(20), config)
    _, undamaged = _play(None, range(20), config)
    assert all(np.isfinite(step.value).all() for step in steps)
    early, late = (
        np.abs(steps[tick].value[BAD_ROBOT] - undamaged[tick].value[BAD_ROBOT])
        for tick in (BAD_STEP, 19)
    )
    assert late < 0.5 * early


def test_states_of_other_robots_are_bounded_by_float32_alone() -> None:
    robot = dataclasses.replace(G1, robot_type="crane", mirror=None)
    policy = Policy(toy_model(robot=robot), FAST_CONFIG, ROBOTS)
    depth, state = _observation(0)
    state[0, 0], state[1, 0], state[2, 0] = 5e3, np.inf, np.nan
    assert policy.act(depth, state).skipped.tolist() == [False, True, True]


def test_depth_that_is_not_finite_is_invalid_depth() -> None:
    with_holes, with_nan = (Policy(toy_model(), FAST_CONFIG, ROBOTS) for _ in range(2))
    depth, state = _observation(0)
    depth[:, 10:20] = 0
    floating = np.where(depth == 0, np.nan, depth.astype(np.float32))
    expected, found = with_holes.act(depth, state), with_nan.act(floating, state)
    np.testing.assert_array_equal(found.plan, expected.plan)
    assert not found.skipped.any()


def test_advance_refuses_an_action_that_is_not_finite() -> None:
    policy, _ = _play(None, range(1))
    with pytest.raises(UsageError, match="not finite"):
        policy.advance(np.full((ROBOTS, A), np.nan))
    with pytest.raises(UsageError, match=r"shape \(7,\), expected \(3, 7\)"):
        policy.advance(np.zeros(A))


def test_observations_of_another_shape_are_refused_with_what_was_expected() -> None:
    policy = Policy(toy_model(), FAST_CONFIG, ROBOTS)
    depth, state = _observation(0)
    for wrong in ((depth, state[:, :73]), (depth[:2], state), (depth[:, :, :32], state)):
        with pytest.raises(UsageError, match=r"expected \(3, 48, 64\) and \(3, 74\)"):
            policy.act(*wrong)
