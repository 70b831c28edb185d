"""Left-right reflection of depth images, states and actions of the G1.

The reflection maps y to -y. Robots of another kind have their own, `RobotSpec.mirror`.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot_spec import G1

assert G1.mirror is not None
STATE_SOURCE: Final = np.array(G1.mirror.state_source, np.intp)
STATE_SIGN: Final = np.array(G1.mirror.state_sign, np.float32)
ACTION_SOURCE: Final = np.array(G1.mirror.action_source, np.intp)
ACTION_SIGN: Final = np.array(G1.mirror.action_sign, np.float32)


def mirror_depth(depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Reflected depth ``(..., H, W)``, a view; the camera is in the plane of symmetry."""
    return depth[..., ::-1]


def mirror_state[F: np.floating](state: NDArray[F]) -> NDArray[F]:
    """Reflected proprioception ``(..., 74)``."""
    return G1.mirrored_state(state)


def mirror_position[F: np.floating](position: NDArray[F]) -> NDArray[F]:
    """Reflected position ``(..., 3)`` in the heading frame."""
    return np.asarray(position * np.array((1.0, -1.0, 1.0), position.dtype))


def mirror_action[F: np.floating](action: NDArray[F]) -> NDArray[F]:
    """Reflected normalised action ``(..., 7)``; the action box is symmetric."""
    return G1.mirrored_action(action)
