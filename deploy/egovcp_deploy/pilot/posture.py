"""How the robot stands, from proprioception alone."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.stance import pelvis_height
from egovcp.spec import STATE_SLICES


class Posture(NamedTuple):
    """What tells a standing robot from a falling one."""

    tilt: float
    """Angle between pelvis and vertical, rad."""
    height: float
    """Pelvis above the lower foot's sole along the vertical, m."""


def posture(state: NDArray[np.floating]) -> Posture:
    """Of one robot, from its state (74,)."""
    s = np.asarray(state, np.float64)
    gravity = s[STATE_SLICES["projected_gravity"]]
    norm = math.sqrt(float(gravity @ gravity))
    tilt = math.acos(min(max(-float(gravity[2]) / max(norm, 1e-9), -1.0), 1.0))
    joints = s[None, STATE_SLICES["joint_position"]]
    return Posture(tilt, float(pelvis_height(joints, gravity[None])[0]))
