"""What many robots measure at once (`egovcp.sim.robot` is for one), and what a critic sees."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.geometry import rotation_matrix
from egovcp.spec import COMMAND_SLICE, STATE_DIM, STATE_SLICES
from egovcp_train.lowlevel.geometry import heading, in_heading
from egovcp_train.lowlevel.physics import Snapshot
from egovcp_train.lowlevel.rewards import standing_feet

Array = NDArray[np.float64]
PRIVILEGED_DIM: Final = 2 + 3 + 1 + 1 + 2 + 2 + 4 + 1  # see `privileged`


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


def privileged(x: Snapshot, motion: Array, height: Array, friction: Array) -> NDArray[np.float32]:
    """What only the simulator knows, (N, 16) for the critic.

    True velocity 2, its average and that of the turning 3, upward velocity 1, height error 1, feet
    on the floor 2, their heights 2, their places along and across 4, friction 1.
    """
    turn = rotation_matrix(x.quaternion)
    forward = heading(turn)
    velocity = in_heading(x.velocity, forward)
    feet = in_heading(x.feet - x.position[:, None], forward)
    columns = [
        velocity,
        motion,
        x.velocity[:, 2:],
        (x.position[:, 2] - height)[:, None],
        standing_feet(x),
        x.feet[..., 2],
        feet.reshape(-1, 4),
        friction[:, None],
    ]
    out = np.concatenate(columns, axis=1)
    return np.asarray(np.nan_to_num(np.clip(out, -10, 10)), dtype=np.float32)
