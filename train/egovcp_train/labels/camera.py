"""Where the camera was, from proprioception alone, in a frame that stays put.

The frame's axes are those of the heading frame in the first row; its origin is the pelvis in
the first row, at neutral height. Orientation comes from gravity, gyroscope and waist, height
from the legs, and the way of a robot that steps from the foot that bears it: it does not slip.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.robot.kinematics import LINK_NAMES, heading_rotation, link_transforms, rotate
from egovcp_train.labels.config import PassingConfig

Array = NDArray[np.float64]

_TORSO: Final = LINK_NAMES.index("torso_link")
_FEET: Final = [LINK_NAMES.index(f"{side}_ankle_roll_link") for side in ("left", "right")]
_STANDING: Final = 0.70  # m, about the height of the pelvis above the ankles in the neutral pose
_SOFT: Final = 0.005  # m of difference in height over which the weight goes to the lower foot


@dataclass(frozen=True)
class CameraTrack:
    """The camera when the picture of each of T rows was taken, and the pelvis at the row itself."""

    rotation: Array
    """(T, 3, 3) camera axes (forward, left, up) in the frame that stays put."""
    position: Array
    """(T, 3) m, of the camera."""
    pelvis: Array
    """(T, 3) m, of the pelvis, its height above the neutral one."""
    yaw: Array
    """(T,) rad, turn of the heading since the first row."""

    def aged(self, age: float) -> CameraTrack:
        """The same for pictures that are older than the state beside them, planner ticks."""
        return replace(
            self, rotation=earlier(self.rotation, age), position=earlier(self.position, age)
        )

    def to_ground(self, point: Array) -> Array:
        """(T, 3) m, camera frame of each row -> the frame that stays put."""
        out: Array = rotate(self.rotation, point) + self.position
        return out

    def to_camera(self, point: Array) -> Array:
        """(T, 3) m, the frame that stays put -> camera frame of each row."""
        out: Array = rotate(np.swapaxes(self.rotation, -1, -2), point - self.position)
        return out


def camera_track(state: NDArray[np.floating], config: PassingConfig) -> CameraTrack:
    """The camera's way through one episode (T, 74), at its rows themselves."""
    s: Array = np.asarray(state, dtype=np.float64)
    angle = yaw(s)
    position, rotation = link_transforms(s[:, spec.STATE_SLICES["joint_position"]])
    level = turn(angle) @ heading_rotation(s[:, spec.STATE_SLICES["projected_gravity"]])
    pelvis = _pelvis(rotate(level[:, None], position[:, _FEET]))
    c, d = np.cos(config.camera_pitch), np.sin(config.camera_pitch)
    tilt = np.array([[c, 0.0, d], [0.0, 1.0, 0.0], [-d, 0.0, c]])
    mount = position[:, _TORSO] + rotate(rotation[:, _TORSO], np.array(config.camera_position))
    axes = level @ rotation[:, _TORSO] @ tilt
    return CameraTrack(axes, pelvis + rotate(level, mount), pelvis, angle)


def _pelvis(feet: Array) -> Array:
    """(T, 2, 3) feet relative to the pelvis -> (T, 3) its way: the lower foot stays where it is."""
    apart = np.clip((feet[:, 0, 2] - feet[:, 1, 2]) / _SOFT, -30.0, 30.0)
    left = 1.0 / (1.0 + np.exp(apart))
    weight = np.stack([left, 1.0 - left], -1)
    moved = -np.diff(feet, axis=0) * (0.5 * (weight[1:] + weight[:-1]))[..., None]
    out = np.concatenate([np.zeros((1, 3)), np.cumsum(moved.sum(1), axis=0)])
    out[:, 2] = -feet[..., 2].min(1) - _STANDING
    return np.asarray(out)


def earlier(rows: Array, age: float) -> Array:
    """(T, ...) -> the same ``age`` rows earlier, interpolated; the first row reaches back."""
    t = np.maximum(np.arange(len(rows)) - age, 0.0)
    before = t.astype(np.intp)
    after = np.minimum(before + 1, len(rows) - 1)
    part = (t - before).reshape(-1, *[1] * (rows.ndim - 1))
    out: Array = (1.0 - part) * rows[before] + part * rows[after]
    return out


def yaw(state: NDArray[np.floating]) -> Array:
    """(T,) rad, turn of the heading since the first row, integrated from the gyroscope."""
    s = np.asarray(state, dtype=np.float64)
    up = heading_rotation(s[:, spec.STATE_SLICES["projected_gravity"]])[:, 2]
    rate = (up * s[:, spec.STATE_SLICES["angular_velocity"]]).sum(-1)
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]))]) * spec.PLANNER_DT


def turn(angle: Array) -> Array:
    """(T,) rad -> (T, 3, 3) rotations about the vertical."""
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    rows = ((c, -s, zero), (s, c, zero), (zero, zero, one))
    return np.stack([np.stack(row, -1) for row in rows], -2)
