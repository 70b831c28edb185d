"""The shipped stance numbers: reproducible, balanced, stable."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp.robot.g1 import STIFFNESS
from egovcp.robot.generate import stance_row
from egovcp.robot.mjcf import robot_spec
from egovcp.robot.stance_design import (
    FOOT_CENTRE,
    Linear,
    Pose,
    StanceModel,
    balanced_pose,
    compensator,
    linearise,
)
from egovcp.robot.stance_table import NF, NU, NX, stance_table
from egovcp.spec import JOINT_NAMES

HEIGHT = 0.58


@pytest.fixture(scope="module")
def stance() -> StanceModel:
    return StanceModel(robot_spec().compile())


@pytest.fixture(scope="module")
def pose(stance: StanceModel) -> Pose:
    return balanced_pose(stance, HEIGHT)


@pytest.fixture(scope="module")
def linear(stance: StanceModel, pose: Pose) -> Linear:
    return linearise(stance, pose)


def test_regenerating_a_height_gives_the_shipped_numbers(stance: StanceModel) -> None:
    fresh, shipped = stance_row(stance, HEIGHT), stance_table().at(np.array([HEIGHT]))
    for name in ("pelvis", "joints", "torque", "mobility", "compensator"):
        np.testing.assert_allclose(getattr(shipped, name)[0], fresh[name], rtol=1e-3, atol=1e-4)


def test_the_pose_is_balanced_on_flat_feet(stance: StanceModel, pose: Pose) -> None:
    stance.place(pose.qpos)
    assert np.abs(stance.feet_error()).max() < 1e-9
    np.testing.assert_allclose(stance.com()[:2], [FOOT_CENTRE, 0.0], atol=1e-5)


@pytest.mark.parametrize("height", [0.50, 0.56, 0.62, 0.70, 0.78])
def test_poses_keep_clear_of_joint_limits(stance: StanceModel, height: float) -> None:
    joints = balanced_pose(stance, height).qpos[7:22]
    limits = np.array([stance.model.joint(name).range for name in JOINT_NAMES[:NU]])
    assert np.all(joints > limits[:, 0] + 0.05)
    assert np.all(joints < limits[:, 1] - 0.05)


def test_holding_torques_leave_no_force_on_the_planted_robot(
    stance: StanceModel, pose: Pose
) -> None:
    residual = stance.force(pose.qpos, pose.qpos[7:22] + pose.torque / STIFFNESS[:NU])
    assert np.abs(residual).max() < 1e-6


def test_standing_is_unstable_open_loop_and_stable_closed(linear: Linear) -> None:
    assert np.abs(np.linalg.eigvals(linear.a)).max() > 1.01
    m = compensator(linear)
    plant, law = slice(0, NX), slice(NX, NX + NF)
    sent = slice(NX + NF, NX + NF + NU)
    measure = m[:, NF : NF + 36] @ linear.c
    loop = np.zeros((NX + NF + NU, NX + NF + NU))
    loop[plant, plant], loop[plant, sent] = linear.a, linear.b
    for rows, part in ((sent, m[:NU]), (law, m[NU:])):
        loop[rows, plant] = measure[:NU] if rows is sent else measure[NU:]
        loop[rows, law], loop[rows, sent] = part[:, :NF], part[:, NF + 36 :]
    assert np.abs(np.linalg.eigvals(loop)).max() < 0.999


def test_heights_between_and_beyond_the_designed_ones() -> None:
    table = stance_table()
    low, high = table.at(np.array([0.56])), table.at(np.array([0.58]))
    middle = table.at(np.array([0.57]))
    np.testing.assert_allclose(middle.joints, (low.joints + high.joints) / 2, atol=1e-12)
    np.testing.assert_array_equal(
        table.at(np.array([9.0])).joints, table.at(np.array([0.78])).joints
    )
    assert np.all(np.isfinite(table.at(np.array([np.nan])).joints))
