"""Where the camera is, from proprioception, in torch; the numbers are those of `egovcp.robot`.

The frame is the pelvis' heading frame (x forward, y left, z up), its origin as high above the
standing foot as the pelvis of the neutral pose: a robot that squats moves down in it.
"""

from __future__ import annotations

from functools import cache
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp import spec
from egovcp.model.config import CameraGeometry
from egovcp.model.kept import constant
from egovcp.robot.g1 import WAIST
from egovcp.robot.kinematics import COS_ROTATION, LINK_OFFSET, REST_ROTATION, SIN_ROTATION

STANDING: Final = 0.70  # m, about the height of the pelvis above the ankles in the neutral pose
_WAIST_AND_LEGS: Final = (
    tuple(range(*WAIST.indices(len(spec.JOINT_NAMES)))),
    tuple(range(6)),
    tuple(range(6, 12)),
)


class CameraPose(NamedTuple):
    """Of N robots."""

    axes: Tensor  # (N, 3, 3) camera axes (forward, left, up) in the heading frame
    position: Tensor  # (N, 3) m
    yaw_rate: Tensor  # (N,) rad/s of the heading


class _Chain(NamedTuple):
    """Joints one after the other, from the pelvis on; (K, J, ...) for K chains of J joints."""

    joints: Tensor  # (K, J) indices
    offset: Tensor  # (K, J, 3)
    rest: Tensor  # (K, J, 3, 3)
    sine: Tensor
    cosine: Tensor


@cache
def _chain(joints: tuple[tuple[int, ...], ...], device: torch.device) -> _Chain:
    """Shorter ones end in links that neither lead on nor turn: all are gone through at once."""
    longest = max(map(len, joints))

    def of(table: NDArray[np.float64], link: NDArray[np.float64]) -> Tensor:
        filled = [[*table[list(chain)], *[link] * (longest - len(chain))] for chain in joints]
        return torch.tensor(np.array(filled), dtype=torch.float32, device=device)

    index = [(*chain, *[0] * (longest - len(chain))) for chain in joints]
    still, none = np.eye(3), np.zeros((3, 3))
    with torch.inference_mode(False):  # what is kept may be wanted in training, too
        return _Chain(
            torch.tensor(index, device=device),
            of(LINK_OFFSET, np.zeros(3)),
            of(np.asarray(REST_ROTATION), still),
            of(np.asarray(SIN_ROTATION), none),
            of(np.asarray(COS_ROTATION), none),
        )


def _end(chain: _Chain, joint_position: Tensor) -> tuple[Tensor, Tensor]:
    """(N, 29) rad -> position (N, K, 3) and rotation (N, K, 3, 3) of the last links."""
    q = joint_position[:, chain.joints][..., None, None]  # (N, K, J, 1, 1)
    local = chain.rest + torch.sin(q) * chain.sine + (1.0 - torch.cos(q)) * chain.cosine
    start = torch.zeros_like(joint_position[:, :1, None])  # a length would be fixed in a graph
    position, rotation = start + chain.offset[:, 0], local[:, :, 0]
    for j in range(1, chain.joints.shape[1]):
        position = position + (rotation @ chain.offset[:, j, :, None])[..., 0]
        rotation = rotation @ local[:, :, j]
    return position, rotation


def camera_pose(state: Tensor, camera: CameraGeometry) -> CameraPose:
    """From raw proprioception (N, 74)."""
    joints = state[:, spec.STATE_SLICES["joint_position"]]
    ends, turns = _end(_chain(_WAIST_AND_LEGS, state.device), joints)
    torso, feet, turn = ends[:, 0], ends[:, 1:], turns[:, 0]
    level = heading_rotation(state[:, spec.STATE_SLICES["projected_gravity"]])
    mount = torso + turn @ constant(camera.position, state)
    tilt = constant(_tilt(camera.pitch), state)
    position = (level @ mount[..., None])[..., 0]
    lowest = (level[:, None] @ feet[..., None])[..., 2, 0].amin(1)
    position = torch.cat([position[:, :2], position[:, 2:] - lowest[:, None] - STANDING], 1)
    rate = (level[:, 2] * state[:, spec.STATE_SLICES["angular_velocity"]]).sum(-1)
    return CameraPose(level @ turn @ tilt, position, rate)


def earlier(state: Tensor, age: Tensor) -> Tensor:
    """Raw proprioception (N, 74) of (N,) s ago, by its own velocities: what the camera's pose is
    made of, gravity and joint positions."""
    then, s = state.clone(), age[:, None]
    joints, velocity, gravity, turn = (
        spec.STATE_SLICES[name]
        for name in ("joint_position", "joint_velocity", "projected_gravity", "angular_velocity")
    )
    then[:, joints] = state[:, joints] - s * state[:, velocity]
    # Of a direction that stays put, in axes that turn: dg/dt = -w x g.
    spun = torch.linalg.cross(state[:, turn], state[:, gravity])
    then[:, gravity] = state[:, gravity] + s * spun
    return then


def _tilt(pitch: float) -> tuple[tuple[float, ...], ...]:
    c, s = float(np.cos(pitch)), float(np.sin(pitch))
    return (c, 0.0, s), (0.0, 1.0, 0.0), (-s, 0.0, c)


def heading_rotation(gravity: Tensor) -> Tensor:
    """`egovcp.robot.kinematics.heading_rotation` of (N, 3), in torch."""
    up = -gravity / gravity.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    x, y, z = up.unbind(-1)
    norm = (y * y + z * z).sqrt().clamp_min(1e-6)
    first = torch.stack([norm, -x * y / norm, -x * z / norm], -1)
    second = torch.stack([torch.zeros_like(x), z / norm, -y / norm], -1)
    return torch.stack([first, second, up], -2)


def turned(angle: Tensor, vectors: Tensor) -> Tensor:
    """Vectors (N, ..., 3) turned about the vertical by (N,) rad."""
    shape = (-1, *[1] * (vectors.dim() - 2))
    c, s = torch.cos(angle).view(shape), torch.sin(angle).view(shape)
    x, y, z = vectors.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y, z], -1)
