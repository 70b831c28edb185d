"""What many robots measure at once (`egovcp.sim.sensors` is for one)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from egovcp.spec import COMMAND_SLICE, STATE_DIM, STATE_SLICES
from egovcp_train.lowlevel.geometry import rotation
from egovcp_train.lowlevel.physics import Snapshot

Array = NDArray[np.float64]


def measure(x: Snapshot, command: Array, std: Array, rng: np.random.Generator) -> Array:
    """Noisy proprioception and the command (N, 10) -> observations (N, 74); always finite."""
    out = np.zeros((len(command), STATE_DIM))
    out[:, STATE_SLICES["angular_velocity"]] = x.angular_velocity
    out[:, STATE_SLICES["projected_gravity"]] = -rotation(x.quaternion)[:, 2]
    out[:, STATE_SLICES["joint_position"]] = x.joints
    out[:, STATE_SLICES["joint_velocity"]] = x.joint_rates
    out += std * rng.standard_normal(out.shape)
    gravity = out[:, STATE_SLICES["projected_gravity"]]
    gravity /= np.linalg.norm(gravity, axis=1, keepdims=True)
    out[:, COMMAND_SLICE] = command
    return np.asarray(np.nan_to_num(out, copy=False, posinf=0.0, neginf=0.0))
