"""Numpy kinematics against MuJoCo's."""

from __future__ import annotations

import hashlib
import json
from importlib import resources

import mujoco
import numpy as np
import pytest

from egovcp.robot import arms, geometry, kinematics
from egovcp.robot.g1 import ARMS
from egovcp.robot.generate import kinematic_table
from egovcp.robot.mjcf import robot_spec
from egovcp.spec import STATE_DIM, STATE_SLICES

Array = kinematics.Array


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return robot_spec().compile()


def _joints(batch: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return rng.uniform(kinematics.JOINT_LOWER, kinematics.JOINT_UPPER, (batch, 29))


def _placed(model: mujoco.MjModel, joints: Array, quaternion: Array) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[3:7], data.qpos[7:] = quaternion, joints
    mujoco.mj_forward(model, data)
    return data


def test_a_change_of_the_kinematics_needs_a_new_identity_of_the_controllers() -> None:
    """`egovcp.robot.stance.identity` does not contain them."""
    table = resources.files("egovcp.robot").joinpath("g1_kinematics.json").read_bytes()
    bounds = np.concatenate([kinematics.TARGET_LOW, kinematics.TARGET_HIGH]).tobytes()
    found = [hashlib.sha256(content).hexdigest()[:16] for content in (table, bounds)]
    assert found == ["c2f65bff3c4866d3", "947d80bb16b54360"], (
        "the kinematics or the bounds of targets have changed: give the controllers a new "
        "identity, so that datasets and policies of both are not mixed, then change these hashes"
    )


def test_shipped_table_is_the_models(model: mujoco.MjModel) -> None:
    assert json.loads(json.dumps(kinematic_table(model))) == kinematics._TABLE


def test_link_transforms_agree_with_mujoco(model: mujoco.MjModel) -> None:
    joints = _joints(8)
    positions, rotations = kinematics.link_transforms(joints)
    links = [model.body(name).id for name in kinematics.LINK_NAMES]
    for q, position, quaternion in zip(
        joints, positions, geometry.quaternion(rotations), strict=True
    ):
        data = _placed(model, q, np.array([1.0, 0, 0, 0]))
        np.testing.assert_allclose(position, data.xpos[links] - data.xpos[1], atol=1e-6)
        alike = np.abs(np.sum(quaternion * data.xquat[links], axis=1))
        np.testing.assert_allclose(alike, 1.0, atol=1e-9)


def test_palms_are_in_the_heading_frame(model: mujoco.MjModel) -> None:
    rng = np.random.default_rng(1)
    for q in _joints(5, seed=2):
        yaw, pitch, roll = rng.uniform(-3, 3), *rng.uniform(-0.6, 0.6, 2)
        half = np.array([yaw, pitch, roll]) / 2
        quaternion = np.zeros(4)
        mujoco.mju_euler2Quat(quaternion, 2 * half, "zyx")
        data = _placed(model, q, quaternion)
        pelvis = data.xmat[1].reshape(3, 3)
        heading = np.array(
            [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
        )
        sites = [model.site(f"{side}_palm").id for side in ("left", "right")]
        expected = (data.site_xpos[sites] - data.xpos[1]) @ heading
        state = np.zeros((1, STATE_DIM))
        state[0, STATE_SLICES["projected_gravity"]] = -pelvis[2]
        state[0, STATE_SLICES["joint_position"]] = q
        np.testing.assert_allclose(kinematics.palm_positions(state)[0], expected, atol=1e-6)


def test_arm_kinematics_agree_with_the_whole_body() -> None:
    joints = _joints(6, seed=3)
    joints[:, :15] = 0.0
    state = np.zeros((6, STATE_DIM))
    state[:, 5] = -1.0
    state[:, STATE_SLICES["joint_position"]] = joints
    torso = kinematics.link_transforms(joints)[0][:, kinematics.LINK_NAMES.index("torso_link")]
    palms = arms.forward(joints[:, ARMS].reshape(-1, 2, 7)).palm + torso[:, None]
    np.testing.assert_allclose(palms, kinematics.palm_positions(state), atol=1e-12)


def test_arm_gravity_torques_agree_with_mujoco(model: mujoco.MjModel) -> None:
    joints = _joints(4, seed=4)
    joints[:, :15] = 0.0
    pose = arms.forward(joints[:, ARMS].reshape(-1, 2, 7))
    gravity = np.tile(model.opt.gravity, (4, 1))
    torque = arms.holding_torque(pose, arms.first_moment(arms.link_coms(pose)), gravity)
    for q, ours in zip(joints, torque, strict=True):
        data = _placed(model, q, np.array([1.0, 0, 0, 0]))
        np.testing.assert_allclose(ours.ravel(), data.qfrc_bias[6:][ARMS], atol=1e-9)
