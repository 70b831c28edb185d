"""What happens to the robots in training: where they start, how they are pushed, their delay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.stance_table import NU, standing_pose
from egovcp.spec import ACTION_BOX, PHYSICS_DT
from egovcp_train.lowlevel.commands import between
from egovcp_train.lowlevel.task import DisturbanceConfig

Array = NDArray[np.float64]
_ARMS: float = 0.1  # rad by which the arms start off the pose


def neutral(n: int) -> Array:
    """(n, 36) pelvis position and quaternion, joints: at the neutral height, facing along x."""
    pose = standing_pose(ACTION_BOX.neutral[-1])
    return np.tile(np.concatenate([pose.position, pose.quaternion, pose.joints]), (n, 1))


def standing(n: int, rng: np.random.Generator) -> Array:
    """(n, 36) as `neutral`, but turned any way and with the arms a little off."""
    qpos, quaternion = neutral(n), standing_pose(ACTION_BOX.neutral[-1]).quaternion
    yaw = rng.uniform(-np.pi, np.pi, n) / 2  # half the angle, as in a quaternion
    pitch = np.arctan2(quaternion[2], quaternion[0])  # half of it, too
    qpos[:, 3:7] = np.stack(
        [
            np.cos(yaw) * np.cos(pitch),
            -np.sin(yaw) * np.sin(pitch),
            np.cos(yaw) * np.sin(pitch),
            np.sin(yaw) * np.cos(pitch),
        ],
        axis=1,
    )
    arms = qpos[:, 7 + NU :]
    arms += rng.uniform(-_ARMS, _ARMS, arms.shape)
    return qpos


def delays(
    n: int, config: DisturbanceConfig, rng: np.random.Generator, timestep: float = PHYSICS_DT
) -> NDArray[np.intp]:
    """(n,) physics steps of ``timestep`` s from a measurement to the new targets' effect."""
    low, high = (round(seconds / timestep) for seconds in config.delay)
    return rng.integers(low, high + 1, n)


def pushes(n: int, config: DisturbanceConfig, difficulty: float, rng: np.random.Generator) -> Array:
    """(n, 2) m/s to add to the pelvis's horizontal velocity, any direction."""
    low, high = config.push
    most = between((low, low), (high, high), difficulty)[0]
    angle = directions(n, rng)
    return kick(rng.uniform(0.0, most, n), angle)


def directions(n: int, rng: np.random.Generator) -> Array:
    """(n,) rad, any."""
    return rng.uniform(-np.pi, np.pi, n)


def kick(speed: Array | float, angle: Array) -> Array:
    """(n, 2) m/s of that speed in the directions ``angle`` (n,)."""
    return np.stack([speed * np.cos(angle), speed * np.sin(angle)], axis=1)
