"""The stance controller in simulation: stands, squats, reaches, survives a push."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

from egovcp.robot import kinematics
from egovcp.robot.arms import ReachConfig
from egovcp.robot.stance import StanceConfig, StanceController
from egovcp.robot.stance_table import standing_pose
from egovcp.spec import ACTION_BOX, ACTION_ETA, NUM_JOINTS, STATE_DIM, STATE_SLICES

Standing = Callable[..., Any]
Array = kinematics.Array


def _states(batch: int, ticks: int, seed: int = 0) -> Array:
    """(ticks, B, S) plausible noisy observations with wandering commands."""
    rng = np.random.default_rng(seed)
    s = np.zeros((ticks, batch, STATE_DIM))
    s[:, :, 5] = -1.0
    s[:, :, STATE_SLICES["joint_position"]] = standing_pose(0.7).joints
    s[:, :, 9:16] = ACTION_BOX.to_metric(rng.uniform(-1, 1, (ticks, batch, 7)))
    s[:, :, :6] += 0.05 * rng.normal(size=(ticks, batch, 6))
    s[:, :, 16:] += 0.05 * rng.normal(size=(ticks, batch, STATE_DIM - 16))
    return s


def _run(controller: StanceController, states: Array) -> Array:
    controller.reset(states[0])
    return np.stack([controller.step(s) for s in states])


@pytest.mark.parametrize("feet", ["points", "stock"])
def test_stands_under_noise_and_delay(standing: Standing, feet: str) -> None:
    robot = standing(feet)
    robot.run(6.0)
    assert robot.upright
    assert abs(robot.data.qpos[2] - 0.74) < 0.01
    assert np.linalg.norm(robot.data.qpos[:2] - standing_pose(0.74).position[:2]) < 0.08


def test_a_fixed_pose_falls(standing: Standing) -> None:
    """The feedback is what keeps it up: the same targets held still do not."""
    robot = standing()
    robot.data.ctrl[:] = robot.controller.step(robot.state())[0]
    for _ in range(600):
        mujoco.mj_step(robot.model, robot.data)
    assert not robot.upright


@pytest.mark.parametrize("height", [0.53, 0.60, 0.68, 0.76])
def test_squats_to_the_commanded_height(standing: Standing, height: float) -> None:
    robot = standing(noise=0.3)
    robot.command[9] = height
    robot.run(3.0)
    assert robot.upright
    assert abs(robot.data.qpos[2] - height) < 0.012


@pytest.mark.parametrize("bearing", np.linspace(0, 2 * np.pi, 6, endpoint=False))
def test_survives_a_push_of_a_fifth_of_a_metre_per_second(
    standing: Standing, bearing: float
) -> None:
    robot = standing(noise=0.5)
    robot.run(0.5)
    robot.data.qvel[:2] += 0.2 * np.array([np.cos(bearing), np.sin(bearing)])
    robot.run(2.5)
    assert robot.upright


@pytest.mark.parametrize(
    "left",
    [(0.35, 0.12, 0.46), (0.38, 0.15, 0.25), (0.25, 0.15, -0.02), (0.30, 0.0, 0.30)],
)
def test_hands_reach_their_targets(standing: Standing, left: tuple[float, float, float]) -> None:
    robot = standing(noise=0.3)
    target = np.array([left, (left[0], -left[1], left[2])])
    robot.command[3:9] = target.ravel()
    robot.run(1.0)
    assert np.linalg.norm(robot.palms() - target, axis=1).max() < 0.04


def test_a_target_beyond_reach_stretches_the_arm(standing: Standing) -> None:
    robot = standing(noise=0.3)
    robot.command[3:9] = [0.55, 0.2, 0.3, 0.55, -0.2, 0.3]
    robot.run(1.0)
    assert robot.palms()[:, 0].min() > 0.38


@pytest.mark.parametrize("seed", [1, 2])
def test_the_random_walk_of_the_data_does_not_make_it_fall(standing: Standing, seed: int) -> None:
    robot = standing(rng=np.random.default_rng(seed))
    walk = np.random.default_rng(100 + seed)
    action: Array = np.zeros(7)
    for _ in range(6 * 25):
        action = action + ACTION_ETA * walk.uniform(-1, 1, 7)
        action = np.where(np.abs(action) > 1, np.sign(action) * 2 - action, action)
        robot.command[3:] = ACTION_BOX.to_metric(action)
        robot.run(0.04)
    assert robot.upright


def test_a_falling_robot_gets_bounded_targets() -> None:
    """Outside the basin the correction fades: no kick, whatever the sensors say."""
    controller = StanceController()
    state = _states(1, 1)[0]
    controller.reset(state)
    for tilt in np.linspace(0.0, 2.5, 60):
        state[0, STATE_SLICES["projected_gravity"]] = [np.sin(tilt), 0.0, -np.cos(tilt)]
        state[0, STATE_SLICES["angular_velocity"]] = [0.0, 3.0, 0.0]
        target = controller.step(state)
    legs = standing_pose(float(state[0, 15])).joints[:12]
    assert np.abs(target[0, :12] - legs).max() < 0.6


def test_a_row_does_not_depend_on_its_batch() -> None:
    states = _states(16, 20)
    together = _run(StanceController(), states)
    for row in (0, 7, 15):
        alone = _run(StanceController(), states[:, row : row + 1])
        np.testing.assert_allclose(together[:, row], alone[:, 0], atol=1e-9)


def test_reset_of_some_rows_leaves_the_others_alone() -> None:
    states = _states(4, 30)
    reference, controller = StanceController(), StanceController()
    controller.reset(states[0])
    expected = _run(reference, states)
    for t in range(15):
        controller.step(states[t])
    controller.reset(states[15], np.array([2]))
    got = np.stack([controller.step(s) for s in states[15:]])
    fresh = _run(StanceController(), states[15:, 2:3])
    np.testing.assert_allclose(got[:, [0, 1, 3]], expected[15:][:, [0, 1, 3]], atol=1e-12)
    np.testing.assert_allclose(got[:, 2], fresh[:, 0], atol=1e-12)


def test_targets_have_a_row_per_robot() -> None:
    assert StanceController().step(_states(3, 1)[0]).shape == (3, NUM_JOINTS)


def test_identity_follows_the_numbers() -> None:
    same, other = StanceController(), StanceController(StanceConfig(reach=ReachConfig(speed=5.0)))
    assert same.id == StanceController().id
    assert same.id.startswith("g1-stance-lqr-")
    assert other.id != same.id
