"""Proprioception: what the IMU and the joint encoders of the robot measure."""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.sim.config import SensorConfig
from egovcp.sim.scene import SceneIndex
from egovcp.spec import COMMAND_SLICE, STATE_DIM, STATE_SLICES

Array = NDArray[np.float64]

_ANGULAR_VELOCITY: Final = STATE_SLICES["angular_velocity"]
_GRAVITY: Final = STATE_SLICES["projected_gravity"]
_POSITION: Final = STATE_SLICES["joint_position"]
_VELOCITY: Final = STATE_SLICES["joint_velocity"]


def base_rotation(quaternion: Array) -> Array:
    """Unit quaternion wxyz (4,) -> rotation (3, 3) from the pelvis frame to the world."""
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, quaternion)
    return out.reshape(3, 3)


def noise_std(config: SensorConfig) -> Array:
    """(S,) standard deviation of each number of a measurement; 0 for the command."""
    out = np.zeros(STATE_DIM)
    out[STATE_SLICES["angular_velocity"]] = config.angular_velocity
    out[STATE_SLICES["projected_gravity"]] = config.gravity
    out[STATE_SLICES["joint_position"]] = config.joint_position
    out[STATE_SLICES["joint_velocity"]] = config.joint_velocity
    return out


class Proprioception:
    """The sensors of one robot in one episode; the command part is left to the caller."""

    def __init__(self, config: SensorConfig, index: SceneIndex, rng: np.random.Generator) -> None:
        self._index = index
        self._rng = rng
        self._std = noise_std(config)
        self._fresh = np.empty(STATE_DIM)
        self._rotation = np.empty(9)

    def measure(self, data: mujoco.MjData, out: Array) -> None:
        """Write a noisy measurement into ``out`` (S,), all but its command part."""
        fresh, qpos, qvel = self._fresh, data.qpos, data.qvel
        self._rng.standard_normal(out=fresh)
        fresh *= self._std
        fresh[_ANGULAR_VELOCITY] += qvel[3:6]
        mujoco.mju_quat2Mat(self._rotation, qpos[3:7])
        gravity = fresh[_GRAVITY]
        gravity -= self._rotation[6:]
        gravity /= np.sqrt(gravity @ gravity)
        fresh[_POSITION] += qpos[self._index.joint_qpos]
        fresh[_VELOCITY] += qvel[self._index.joint_qvel]
        out[: COMMAND_SLICE.start] = fresh[: COMMAND_SLICE.start]
        out[COMMAND_SLICE.stop :] = fresh[COMMAND_SLICE.stop :]
