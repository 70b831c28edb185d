"""A reading of joints and IMU as the observation that controllers and policies know."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from egovcp.spec import COMMAND_SLICE, STATE_DIM, STATE_SLICES
from egovcp_deploy.robots.body import BodyState


def proprioception(body: BodyState, command: NDArray[np.floating]) -> NDArray[np.float64]:
    """(74,) in the layout of `spec.STATE_SLICES`.

    Args:
        body: the reading.
        command: (10,) the last one sent: velocity 3, hands 6 (m), height (m).
    """
    state = np.empty(STATE_DIM)
    state[STATE_SLICES["angular_velocity"]] = body.angular_velocity
    state[STATE_SLICES["projected_gravity"]] = projected_gravity(body.quaternion_w)
    state[COMMAND_SLICE] = command
    state[STATE_SLICES["joint_position"]] = body.joint_position
    state[STATE_SLICES["joint_velocity"]] = body.joint_velocity
    return state


def projected_gravity(quaternion_w: NDArray[np.floating]) -> NDArray[np.float64]:
    """(3,) the world's down, (0, 0, -1), in the frame of a unit quaternion wxyz (4,)."""
    w, x, y, z = (float(part) for part in quaternion_w)
    return np.array([2.0 * (w * y - x * z), -2.0 * (w * x + y * z), 2.0 * (x * x + y * y) - 1.0])
