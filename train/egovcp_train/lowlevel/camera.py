"""Rotation of the head camera: rotation vectors in the torso frame, and pixels of its depth image.

A rotation by a small angle moves the middle of the image by f times the angle, f = 43.3 pixels per
rad for 48 rows and a vertical field of view of 58 degrees. A roll moves the image's left and right
edges, 32 pixels from the middle, by 32 times the angle.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.g1 import WAIST
from egovcp.robot.geometry import focal_length, rotation_matrix, rotation_vector
from egovcp.robot.kinematics import torso_rotation
from egovcp.sim.config import CameraConfig
from egovcp.spec import CONTROLLER_HZ, CONTROLLER_TICKS_PER_PLAN, DEPTH_COLS
from egovcp_train.lowlevel.physics import Snapshot

Array = NDArray[np.float64]
FOCAL: Final = focal_length(CameraConfig().vertical_fov)
"""Pixels per rad in the middle of the depth image."""
_ROLL: Final = DEPTH_COLS / 2  # pixels from the middle to the left or right edge
_FASTEST: Final = 20.0  # rad/s, bound of the angular velocities of a robot that diverges


def torso(x: Snapshot) -> Array:
    """(N, 3, 3) rotation from the torso, which carries the camera, to the world."""
    return torso_rotation(rotation_matrix(x.quaternion), x.joints[:, WAIST])


def pixels(vector: Array) -> Array:
    """Rotation vectors (..., 3) rad -> (..., 3) pixels up, across, and by roll at the edge."""
    return np.stack(
        [FOCAL * vector[..., 1], FOCAL * vector[..., 2], _ROLL * vector[..., 0]], axis=-1
    )


class TorsoMotion:
    """Angular velocity of the torso, averaged over a tick, and its change over a planner step."""

    def __init__(self, robots: int) -> None:
        self._attitude: Array = np.tile(np.eye(3), (robots, 1, 1))
        self._known = np.zeros(robots, dtype=np.bool_)
        self._rates: Array = np.zeros((CONTROLLER_TICKS_PER_PLAN + 1, robots, 3))  # newest last

    @property
    def rate(self) -> Array:
        """(N, 3) rad/s, torso frame; 0 in the first tick."""
        return np.asarray(self._rates[-1])

    @property
    def change(self) -> Array:
        """(N, 3) rad/s, the rate minus that of one planner step before."""
        return np.asarray(self._rates[-1] - self._rates[0])

    def reset(self, rows: NDArray[np.intp]) -> None:
        """Robots that start from rest."""
        self._known[rows] = False
        self._rates[:, rows] = 0.0

    def add(self, x: Snapshot) -> None:
        """One tick of 20 ms."""
        attitude = np.nan_to_num(torso(x))
        rate = rotation_vector(self._attitude, attitude) * CONTROLLER_HZ
        rate[~self._known] = 0.0
        self._rates = np.roll(self._rates, -1, axis=0)
        self._rates[-1] = np.clip(rate, -_FASTEST, _FASTEST)
        self._attitude, self._known[:] = attitude, True
