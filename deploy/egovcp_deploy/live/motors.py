"""What the motors are told in each state: damped, coming in, or following the controller.

No position leaves these functions beyond the bounds of `egovcp.robot.kinematics`, whatever they are
given; numbers that are not finite become the middle of the joint's range.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.kinematics import TARGET_HIGH, TARGET_LOW
from egovcp.spec import NUM_JOINTS
from egovcp_deploy.robots.base import MotorCommand

Array = NDArray[np.float64]

#: N m s/rad while damped: legs and waist let a standing robot sink in about a second.
DAMPED: Final = np.concatenate([np.full(15, 8.0), np.full(NUM_JOINTS - 15, 2.0)])


_MIDDLE: Final = (TARGET_LOW + TARGET_HIGH) / 2


def _bounded(position: NDArray[np.floating]) -> Array:
    where = np.asarray(position, np.float64)
    return np.clip(np.where(np.isfinite(where), where, _MIDDLE), TARGET_LOW, TARGET_HIGH)


def damped(position: NDArray[np.floating] | None, mode: int) -> MotorCommand:
    """No stiffness at all; ``position`` (29,) is where the joints are, if that is known."""
    where = np.zeros(NUM_JOINTS) if position is None else np.asarray(position, np.float64)
    return MotorCommand(_bounded(where), np.zeros(NUM_JOINTS), DAMPED, mode)


def following(target: Array, stiffness: Array, damping: Array, mode: int) -> MotorCommand:
    """Full gains towards ``target`` (29,), inside what the joints can do."""
    return MotorCommand(_bounded(target), stiffness, damping, mode)


def coming_in(
    start: Array, target: Array, stiffness: Array, damping: Array, share: float, mode: int
) -> MotorCommand:
    """The gains' ramp: at ``share`` 0 damped where the joints were, at 1 following ``target``."""
    share = min(max(share, 0.0), 1.0)
    position = (1 - share) * _bounded(start) + share * _bounded(target)
    soft = (1 - share) * DAMPED + share * damping
    return MotorCommand(position, share * stiffness, soft, mode)
