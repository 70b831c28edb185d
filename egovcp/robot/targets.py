"""Bounds of the joint position targets that a low-level controller may give.

A target may pass the end of a joint's range. The servo makes torque from the difference between
target and position, so a joint that carries load near its stop needs a target beyond it: with
29 N m/rad an ankle's target is 0.6 rad beyond its position to hold 17 N m. How far each joint's
targets go was measured with ``benchmarks/joint_targets.py``: all three tasks, 16 robots of each,
both controllers, falls left out. The greatest excess is in the comments (rad; 0.6 is where both
controllers were trained and tuned to stop). Joints whose targets stay inside their range get 0.1.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.kinematics import JOINT_LOWER, JOINT_UPPER
from egovcp.spec import JOINT_NAMES

#: Joint name ending -> rad below and above the range, for the left side; roll and yaw of the right
#: side are mirrored.
_SLACK: Final[dict[str, tuple[float, float]]] = {
    "hip_pitch": (0.6, 0.1),  # 0.58, -
    "hip_roll": (0.4, 0.1),  # 0.25, -
    "hip_yaw": (0.1, 0.1),
    "knee": (0.6, 0.1),  # 0.46, -
    "ankle_pitch": (0.6, 0.6),  # 0.6, 0.6
    "ankle_roll": (0.6, 0.6),  # 0.6, 0.6
    "waist_yaw": (0.1, 0.1),
    "waist_roll": (0.6, 0.6),  # 0.6, 0.6
    "waist_pitch": (0.6, 0.6),  # 0.55, 0.43
    "shoulder_pitch": (0.1, 0.1),
    "shoulder_roll": (0.3, 0.6),  # 0.17, 0.6
    "shoulder_yaw": (0.1, 0.1),
    "elbow": (0.6, 0.1),  # 0.56, -
    "wrist_roll": (0.1, 0.1),
    "wrist_pitch": (0.1, 0.1),
    "wrist_yaw": (0.1, 0.1),
}


def _slack(joint: str) -> tuple[float, float]:
    kind = joint.removesuffix("_joint").removeprefix("left_").removeprefix("right_")
    below, above = _SLACK[kind]
    mirrored = joint.startswith("right_") and kind.endswith(("roll", "yaw"))
    return (above, below) if mirrored else (below, above)


_BELOW, _ABOVE = np.array([_slack(name) for name in JOINT_NAMES]).T
TARGET_LOW: Final[NDArray[np.float64]] = JOINT_LOWER - _BELOW  # (J,) rad
TARGET_HIGH: Final[NDArray[np.float64]] = JOINT_UPPER + _ABOVE  # (J,) rad
