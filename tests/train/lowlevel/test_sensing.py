"""Rotation of the camera, in radians per second and in pixels."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egovcp.robot.geometry import rotation_vector
from egovcp.sim.camera import RayCastCamera
from egovcp.sim.config import CameraConfig
from egovcp_train.lowlevel import sensing
from egovcp_train.lowlevel.config import DisturbanceConfig
from egovcp_train.lowlevel.physics import BatchPhysics, Snapshot, neutral_qpos
from egovcp_train.lowlevel.sensing import TorsoMotion


def test_the_focal_length_is_that_of_the_depth_image():
    assert pytest.approx(RayCastCamera(CameraConfig()).focal) == sensing.FOCAL
    assert pytest.approx(43.3, abs=0.01) == sensing.FOCAL


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.3, 3.0])
def test_a_rotation_vector_is_axis_times_angle(angle: float):
    before = Rotation.from_rotvec([0.2, -0.4, 0.7])
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3
    after = before * Rotation.from_rotvec(vector)
    found = rotation_vector(before.as_matrix()[None], after.as_matrix()[None])
    np.testing.assert_allclose(found[0], vector, atol=1e-9)


def test_pixels_are_those_of_pitch_yaw_and_roll():
    roll, pitch, yaw = 0.1 * np.eye(3)
    found = sensing.pixels(np.stack([pitch, yaw, roll]))
    np.testing.assert_allclose(found, np.diag([4.33, 4.33, 3.2]), atol=0.01)


def _standing(n: int) -> Snapshot:
    physics = BatchPhysics(n, "points", DisturbanceConfig(models=1), 1, 0)
    qpos = neutral_qpos(n)
    physics.place(np.arange(n), qpos, qpos[:, 7:])
    x = physics.snapshot()
    physics.close()
    return x


def _yawed(x: Snapshot, angle: float) -> Snapshot:
    turn = Rotation.from_euler("z", angle)
    turned = turn * Rotation.from_quat(x.quaternion, scalar_first=True)
    return replace(x, quaternion=turned.as_quat(scalar_first=True))


def test_the_torsos_rate_and_its_change_over_a_planner_step():
    x, motion = _standing(2), TorsoMotion(2)
    motion.add(x)
    assert not motion.rate.any()
    for angle in (0.0, 0.0, 0.01):
        motion.add(_yawed(x, angle))
    np.testing.assert_allclose(np.linalg.norm(motion.rate, axis=1), 0.5, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(motion.change, axis=1), 0.5, atol=1e-6)
    motion.reset(np.array([1]))
    motion.add(_yawed(x, 0.02))
    np.testing.assert_allclose(np.linalg.norm(motion.rate, axis=1), [0.5, 0.0], atol=1e-6)


def test_a_robot_that_diverged_has_a_finite_rate():
    x, motion = _standing(2), TorsoMotion(2)
    motion.add(x)
    wild = x.quaternion.copy()
    wild[1] = np.nan
    motion.add(replace(x, quaternion=wild))
    assert np.isfinite(motion.rate).all()
