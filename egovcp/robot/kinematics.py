"""Forward kinematics and joint limits of the G1 in numpy, batched over robots; without MuJoCo.

Every joint is a hinge at its link's origin, so a link's pose follows from its parent's:

    R_i = R_p R0_i exp([a_i] q_i)        p_i = p_p + R_p r_i

With K = [a] (cross-product matrix), exp(K q) = 1 + sin q K + (1 - cos q) K^2, hence the
three constant matrices per joint below. The constants come from ``g1_kinematics.json``,
which ``python -m egovcp.robot.generate`` writes from the model.
"""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.g1 import WAIST, joint_kind
from egovcp.robot.geometry import Array, heading_rotation, rotate
from egovcp.spec import JOINT_NAMES, STATE_SLICES

_TABLE: Final = json.loads(
    resources.files("egovcp.robot").joinpath("g1_kinematics.json").read_text(encoding="utf-8")
)
#: The pelvis and the child link of each joint, in JOINT_NAMES order: link i+1 is moved by joint i.
LINK_NAMES: Final[tuple[str, ...]] = tuple(_TABLE["links"])
NUM_LINKS: Final = len(LINK_NAMES)
PARENT: Final[tuple[int, ...]] = tuple(_TABLE["parent"])
LINK_MASS: Final[Array] = np.array(_TABLE["mass"])  # (L,) kg
LINK_COM: Final[Array] = np.array(_TABLE["com"])  # (L, 3) m, link frame
JOINT_AXIS: Final[Array] = np.array(_TABLE["axis"])  # (J, 3) child link frame
JOINT_LOWER: Final[Array] = np.array(_TABLE["lower"])  # (J,) rad
JOINT_UPPER: Final[Array] = np.array(_TABLE["upper"])  # (J,) rad
PALM_OFFSET: Final[Array] = np.array(_TABLE["palm"])  # (2, 3) m, wrist yaw link frame, left, right
JOINT_OFFSET: Final[Array] = np.array(_TABLE["offset"])  # (J, 3) m, in the parent's frame

ANKLE_HEIGHT: Final = 0.035  # m, ankle-roll frame above the sole
HALF_STANCE_WIDTH: Final = 0.1185  # m, from the ankles to the midline in the standing pose
_NUM_LEG_JOINTS: Final = 12  # the first joints; each leg is a chain of six from the pelvis
#: Links that carry the palms, left and right.
WRISTS: Final = [LINK_NAMES.index(f"{side}_wrist_yaw_link") for side in ("left", "right")]


def _cross_matrices(axis: Array) -> Array:
    """K of each axis, (J, 3, 3)."""
    x, y, z = axis.T
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(-1, 3, 3)


#: R0, R0 K and R0 K^2, (J, 3, 3) each.
REST_ROTATION: Final[Array] = np.array(_TABLE["rest"])
SIN_ROTATION: Final[Array] = REST_ROTATION @ _cross_matrices(JOINT_AXIS)
COS_ROTATION: Final[Array] = SIN_ROTATION @ _cross_matrices(JOINT_AXIS)


#: How far the targets of low-level controllers may leave a joint's range: joint name ending -> rad
#: below and above, left side; roll and yaw of the right side are mirrored. A servo's torque is
#: proportional to target minus position, so a loaded joint near its stop needs a target beyond it:
#: 0.6 rad for an ankle to hold 17 N m with 29 N m/rad. Comments: the greatest excess measured with
#: ``benchmarks/joint_targets.py`` over all tasks and controllers, which clip at 0.6.
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
    """rad below and above the joint's range."""
    kind = joint_kind(joint)
    below, above = _SLACK[kind]
    mirrored = joint.startswith("right_") and kind.endswith(("roll", "yaw"))
    return (above, below) if mirrored else (below, above)


_BELOW, _ABOVE = np.array([_slack(name) for name in JOINT_NAMES]).T
TARGET_LOW: Final[NDArray[np.float64]] = JOINT_LOWER - _BELOW  # (J,) rad
TARGET_HIGH: Final[NDArray[np.float64]] = JOINT_UPPER + _ABOVE  # (J,) rad


def joint_rotations(joint_position: Array, joints: slice = slice(None)) -> Array:
    """Rotation from each joint's child frame to its parent's: (..., J') -> (..., J', 3, 3)."""
    s = np.sin(joint_position)[..., None, None]
    c = 1.0 - np.cos(joint_position)[..., None, None]
    out: Array = REST_ROTATION[joints] + s * SIN_ROTATION[joints] + c * COS_ROTATION[joints]
    return out


def torso_rotation(heading: Array, waist: Array) -> Array:
    """Rotation (B, 3, 3) from the torso to the pelvis heading frame.

    Args:
        heading: (B, 3, 3) from the pelvis to the heading frame (`heading_rotation`).
        waist: (B, 3) yaw, roll and pitch of the waist, rad.
    """
    turn = joint_rotations(waist, WAIST)
    return np.asarray(heading @ turn[:, 0] @ turn[:, 1] @ turn[:, 2])


@cache
def _levels() -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], ...]:
    """Links grouped by depth in the tree: (links, parents) per level, pelvis left out."""
    depth = [0] * NUM_LINKS
    for link in range(1, NUM_LINKS):
        depth[link] = depth[PARENT[link]] + 1
    levels = []
    for level in range(1, max(depth) + 1):
        links = np.array([i for i in range(NUM_LINKS) if depth[i] == level])
        levels.append((links, np.array([PARENT[i] for i in links])))
    return tuple(levels)


def link_transforms(joint_position: Array) -> tuple[Array, Array]:
    """(B, J) -> pelvis-relative positions (B, L, 3) and rotations (B, L, 3, 3) of all links."""
    q = np.asarray(joint_position, dtype=np.float64)
    local = joint_rotations(q)
    position = np.zeros((len(q), NUM_LINKS, 3))
    rotation = np.empty((len(q), NUM_LINKS, 3, 3))
    rotation[:, 0] = np.eye(3)
    for links, parents in _levels():
        base = rotation[:, parents]
        position[:, links] = position[:, parents] + rotate(base, JOINT_OFFSET[links - 1])
        rotation[:, links] = base @ local[:, links - 1]
    return position, rotation


def foot_positions(joint_position: Array) -> Array:
    """(B, 2, 3) m, left and right ankle-roll link in the pelvis frame, of (B, J) rad."""
    n, legs = len(joint_position), slice(0, _NUM_LEG_JOINTS)
    local = joint_rotations(joint_position[:, legs], legs)
    local = local.reshape(n, 2, _NUM_LEG_JOINTS // 2, 3, 3)
    offset = JOINT_OFFSET[legs].reshape(2, -1, 3)
    rotation, position = local[:, :, 0], np.tile(offset[:, 0], (n, 1, 1))
    for k in range(1, local.shape[2]):
        position = position + rotate(rotation, offset[:, k])
        rotation = rotation @ local[:, :, k]
    return np.asarray(position)


def palm_positions(state: NDArray[np.floating]) -> Array:
    """Palm sites (left, right) in the pelvis heading frame, as the robot measures them.

    Args:
        state: (B, S) observations in the layout of ``spec.STATE_SLICES``.

    Returns:
        (B, 2, 3) m.
    """
    s = np.asarray(state, dtype=np.float64)
    position, rotation = link_transforms(s[:, STATE_SLICES["joint_position"]])
    palms = position[:, WRISTS] + rotate(rotation[:, WRISTS], PALM_OFFSET)
    return rotate(heading_rotation(s[:, STATE_SLICES["projected_gravity"]])[:, None], palms)
