"""Measurements of many simulated robots: frames, proprioception, critic input, camera rotation.

A rotation of the head camera by a small angle moves the centre of its depth image by f times the
angle, f = 43.3 pixels per rad for 48 rows and a vertical field of view of 58 degrees. A roll moves
the left and right edges, 32 pixels from the centre, by 32 times the angle.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.g1 import WAIST
from egovcp.robot.geometry import focal_length, rotation_matrix, rotation_vector
from egovcp.robot.kinematics import ANKLE_HEIGHT, torso_rotation
from egovcp.sim.config import CameraConfig
from egovcp.spec import (
    COMMAND_SLICE,
    CONTROLLER_HZ,
    CONTROLLER_TICKS_PER_PLAN,
    DEPTH_COLS,
    STATE_DIM,
    STATE_SLICES,
)
from egovcp_train.lowlevel.physics import Snapshot

Array = NDArray[np.float64]
FOCAL: Final = focal_length(CameraConfig().vertical_fov)
"""Pixels per rad at the centre of the depth image."""
PRIVILEGED_DIM: Final = 2 + 3 + 1 + 1 + 2 + 2 + 4 + 1 + 1  # see `privileged`
_CONTACT_MARGIN: Final = 0.012  # m above ANKLE_HEIGHT, below which a foot counts as standing
_MAX_TORSO_RATE: Final = 20.0  # rad/s, bound for robots whose simulation diverges


def heading(rotation: Array) -> Array:
    """(N, 3, 3) rotations -> (N, 2) unit vector of the horizontal forward direction."""
    forward = rotation[:, :2, 0]
    return np.asarray(forward / np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-6))


def to_heading_xy(vector: Array, forward: Array) -> Array:
    """World vectors (N, ..., 2 or 3) -> their x and y in the heading frame (N, ..., 2)."""
    shape = (len(forward), *(1,) * (vector.ndim - 2))
    c, s = forward[:, 0].reshape(shape), forward[:, 1].reshape(shape)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([c * x + s * y, c * y - s * x], axis=-1)


def standing_feet(x: Snapshot) -> NDArray[np.bool_]:
    """(N, 2) which feet are on the floor."""
    on: NDArray[np.bool_] = x.feet[..., 2] < ANKLE_HEIGHT + _CONTACT_MARGIN
    return on


def measure(x: Snapshot, command: Array, std: Array, rng: np.random.Generator) -> Array:
    """Noisy proprioception and the command (N, 10) -> observations (N, 74); always finite."""
    out = np.zeros((len(command), STATE_DIM))
    out[:, STATE_SLICES["angular_velocity"]] = x.angular_velocity
    out[:, STATE_SLICES["projected_gravity"]] = -rotation_matrix(x.quaternion)[:, 2]
    out[:, STATE_SLICES["joint_position"]] = x.joints
    out[:, STATE_SLICES["joint_velocity"]] = x.joint_rates
    out += std * rng.standard_normal(out.shape)
    gravity = out[:, STATE_SLICES["projected_gravity"]]
    gravity /= np.linalg.norm(gravity, axis=1, keepdims=True)
    out[:, COMMAND_SLICE] = command
    return np.asarray(np.nan_to_num(out, copy=False, posinf=0.0, neginf=0.0))


def privileged(
    x: Snapshot, motion: Array, height: Array, friction: Array, wall: Array
) -> NDArray[np.float32]:
    """Additional input of the critic, (N, 17).

    Horizontal velocity (2), running average of it and of the yaw rate (3), upward velocity (1),
    height error (1), feet on the floor (2), their heights (2), their positions along and across
    (4), friction (1), distance of a wall (1).
    """
    forward = heading(rotation_matrix(x.quaternion))
    columns = [
        to_heading_xy(x.velocity, forward),
        motion,
        x.velocity[:, 2:],
        (x.position[:, 2] - height)[:, None],
        standing_feet(x),
        x.feet[..., 2],
        to_heading_xy(x.feet - x.position[:, None], forward).reshape(-1, 4),
        friction[:, None],
        wall[:, None],
    ]
    out = np.concatenate(columns, axis=1)
    return np.asarray(np.nan_to_num(np.clip(out, -10, 10)), dtype=np.float32)


# --- rotation of the camera ----------------------------------------------------------
def torso(x: Snapshot) -> Array:
    """(N, 3, 3) rotation from the torso, which carries the camera, to the world."""
    return torso_rotation(rotation_matrix(x.quaternion), x.joints[:, WAIST])


def pixels(vector: Array) -> Array:
    """Rotation vectors (..., 3) rad -> (..., 3) pixels up, across, and by roll at the edge."""
    scales = [FOCAL, FOCAL, DEPTH_COLS / 2]
    return np.asarray(vector[..., [1, 2, 0]] * scales)


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
        """Adds a tick of 20 ms."""
        attitude = np.nan_to_num(torso(x))
        rate = rotation_vector(self._attitude, attitude) * CONTROLLER_HZ
        rate[~self._known] = 0.0
        self._rates = np.roll(self._rates, -1, axis=0)
        self._rates[-1] = np.clip(rate, -_MAX_TORSO_RATE, _MAX_TORSO_RATE)
        self._attitude, self._known[:] = attitude, True
