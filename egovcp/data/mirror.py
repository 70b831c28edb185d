"""Left-right reflection of depth images, states and actions.

The reflection maps y to -y. Vectors change the sign of y; axial vectors (angular
velocity) that of x and z; left and right limbs are exchanged; a joint angle keeps its sign if
the axis is y (pitch, knee, elbow) and changes it if the axis is x or z (roll, yaw).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp import spec

_POLAR: Final = (1.0, -1.0, 1.0)  # position, velocity, gravity
_AXIAL: Final = (-1.0, 1.0, -1.0)  # angular velocity
_PLANAR: Final = (1.0, -1.0, -1.0)  # vx, vy, yaw rate
_OTHER_HAND: Final = (3, 4, 5, 0, 1, 2)


def _other_side(joint: str) -> str:
    side, _, rest = joint.partition("_")
    return {"left": f"right_{rest}", "right": f"left_{rest}"}.get(side, joint)


def _joint_sign(joint: str) -> float:
    return -1.0 if joint.endswith(("_roll_joint", "_yaw_joint")) else 1.0


_JOINT_SOURCE: Final = tuple(spec.JOINT_NAMES.index(_other_side(j)) for j in spec.JOINT_NAMES)
_JOINT_SIGN: Final = tuple(_joint_sign(j) for j in spec.JOINT_NAMES)


def _state_maps() -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    source, sign = np.arange(spec.STATE_DIM), np.ones(spec.STATE_DIM, dtype=np.float32)
    at = spec.STATE_SLICES
    sign[at["angular_velocity"]] = _AXIAL
    sign[at["projected_gravity"]] = _POLAR
    sign[at["command_velocity"]] = _PLANAR
    sign[at["command_hands"]] = _POLAR + _POLAR
    source[at["command_hands"]] = source[at["command_hands"]][list(_OTHER_HAND)]
    for part in ("joint_position", "joint_velocity"):
        sign[at[part]] = _JOINT_SIGN
        source[at[part]] = source[at[part]][list(_JOINT_SOURCE)]
    return source, sign


STATE_SOURCE, STATE_SIGN = _state_maps()
ACTION_SOURCE: Final = np.array([*_OTHER_HAND, 6])
ACTION_SIGN: Final = np.array([*_POLAR, *_POLAR, 1.0], dtype=np.float32)


def mirror_depth(depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Reflected depth ``(..., H, W)``, a view; the camera is in the plane of symmetry."""
    return depth[..., ::-1]


def mirror_state[F: np.floating](state: NDArray[F]) -> NDArray[F]:
    """Reflected proprioception ``(..., 74)``."""
    return np.asarray(state[..., STATE_SOURCE] * STATE_SIGN.astype(state.dtype))


def mirror_position[F: np.floating](position: NDArray[F]) -> NDArray[F]:
    """Reflected position ``(..., 3)`` in the heading frame."""
    return np.asarray(position * np.array(_POLAR, position.dtype))


def mirror_action[F: np.floating](action: NDArray[F]) -> NDArray[F]:
    """Reflected normalised action ``(..., 7)``; the action box is symmetric."""
    return np.asarray(action[..., ACTION_SOURCE] * ACTION_SIGN.astype(action.dtype))
