"""What a picture shows of the floor on which the robot stands.

Nothing else is as sure to be where proprioception says: a floor that seems to rise and sink while
the robot sways was seen at another time than the proprioception beside it
(`egovcp.model.picture_age`).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from torch import Tensor

from egovcp.model.camera_pose import STANDING, CameraPose
from egovcp.model.config import CameraGeometry

LEVEL: Final = -(STANDING + 0.04)  # m, in the frame of `CameraPose`: soles are below the ankles
_FIRST_ROW: Final = 2 / 3  # of the picture; above, hardly any floor is in range
_EVERY: Final = 2  # columns: half of the pixels say as much
_NEAR: Final = 0.45  # m above or below the floor, within which it may seem to be
_MIN_PIXELS: Final = 10


class Floor(NamedTuple):
    """What N pictures show, in the left and the right half of each."""

    point: Tensor  # (N, 2, 3) m, camera frame (forward, left, up), mean of the floor's pixels
    seen: Tensor  # (N, 2) 1 where there are enough of them, else 0


def floor(near: Tensor, pose: CameraPose, max_m: float, camera: CameraGeometry) -> Floor:
    """The pixels of (N, H, W) nearness that lie about where the floor is.

    Args:
        near: 0 where nothing is in range.
        pose: of the camera, roughly.
        max_m: depth at which nearness is 0, m.
        camera: its field of view.
    """
    height, width = near.shape[-2:]
    focal, top = height / 2 / camera.half_height, int(height * _FIRST_ROW)
    near = near[:, top:, ::_EVERY]
    up = -(torch.arange(top, height, device=near.device) - (height - 1) / 2)[:, None] / focal
    left = -(torch.arange(0, width, _EVERY, device=near.device) - (width - 1) / 2) / focal
    depth = (1.0 - near) * max_m
    forward, sideways, upwards = pose.axes[:, 2, :, None, None].unbind(1)  # (N, 1, 1) each
    above = (forward + sideways * left + upwards * up) * depth
    above = above + (pose.position[:, 2] - LEVEL)[:, None, None]
    own = ((near > 0) & (above.abs() < _NEAR)).to(near.dtype)
    halves = torch.stack([own, own * depth * left, own * depth * up, own * depth], 1)
    halves = halves.view(*halves.shape[:-1], 2, -1).sum((-3, -1))  # (N, 4, 2)
    count, to_left, to_up, ahead = halves.unbind(1)
    point = torch.stack([ahead, to_left, to_up], -1) / count.clamp_min(1.0)[..., None]
    return Floor(point, (count >= _MIN_PIXELS).to(near.dtype))
