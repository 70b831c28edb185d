"""The stance law's numbers (``g1_stance.npz``), looked up by pelvis height."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from functools import cache
from importlib import resources
from typing import Final

import numpy as np

from egovcp.robot.arms import REST
from egovcp.robot.g1 import ARMS, WAIST
from egovcp.robot.geometry import Array
from egovcp.spec import NUM_JOINTS

NZ: Final = 9  # coordinates: pelvis pose 6, waist 3
NX: Final = 2 * NZ  # states: coordinates and their rates
NR: Final = 2  # roll and pitch of feet that rock on their edges
NF: Final = NX + NR + NZ  # filter: states, rocking, and a slowly changing force on each coordinate
NU: Final = 15  # servo targets: legs 12, waist 3
NY: Final = 36  # measurements: gravity 3, gyro 3, joint positions 15, joint rates 15


@dataclass(frozen=True)
class StanceRow:
    """The law's numbers for each robot; leading axis B."""

    pelvis: Array  # (B, 3) x, y of the pelvis from the ankles' middle (m), pitch (rad)
    joints: Array  # (B, 15) rad
    torque: Array  # (B, 15) N m
    pelvis_per_moment: Array  # (B, 2, 2) m per kg m
    joints_per_moment: Array  # (B, 15, 2) rad per kg m
    torque_per_moment: Array  # (B, 15, 2) N m per kg m
    mobility: Array  # (B, 9, 9) pelvis and waist rates per generalised impulse
    compensator: Array  # (B, 44, 80)


_FIELDS: Final = [field.name for field in fields(StanceRow)]


class StanceTable:
    """Linear interpolation between the designed heights; clamped at both ends."""

    def __init__(self, arrays: dict[str, Array]) -> None:
        self.heights = arrays["height"]
        parts = [arrays[name].astype(np.float64).reshape(len(self.heights), -1) for name in _FIELDS]
        self._shapes = [arrays[name].shape[1:] for name in _FIELDS]
        ends = np.cumsum([part.shape[1] for part in parts])
        self._slices = [slice(e - p.shape[1], e) for e, p in zip(ends, parts, strict=True)]
        self._flat = np.concatenate(parts, axis=1)
        self._slope = np.diff(self._flat, axis=0) / np.diff(self.heights)[:, None]

    def clamp(self, height: Array) -> Array:
        """Heights within the table; not-a-number becomes the lowest."""
        return np.asarray(np.fmin(np.fmax(height, self.heights[0]), self.heights[-1]))

    def at(self, height: Array) -> StanceRow:
        """Numbers for heights (B,) in metres."""
        h = self.clamp(height)
        index = np.searchsorted(self.heights[1:-1], h, side="right")
        flat = self._slope[index] * (h - self.heights[index])[:, None]
        flat += self._flat[index]
        fields = zip(self._slices, self._shapes, strict=True)
        return StanceRow(*(flat[:, part].reshape(len(h), *shape) for part, shape in fields))

    def fingerprint(self) -> str:
        """8 hexadecimal digits that change with any number of the table."""
        return hashlib.sha256(self._flat.tobytes() + self.heights.tobytes()).hexdigest()[:8]


@cache
def stance_table() -> StanceTable:
    """The table that the package ships."""
    path = resources.files("egovcp.robot").joinpath("g1_stance.npz")
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        return StanceTable({name: arrays[name] for name in arrays.files})


@dataclass(frozen=True)
class StandingPose:
    """A static pose on two flat feet, for placing a robot in a scene."""

    position: Array  # (3,) pelvis, m; the middle between the ankles is at x = y = 0
    quaternion: Array  # (4,) wxyz
    joints: Array  # (J,) rad, JOINT_NAMES order


def standing_pose(height: float) -> StandingPose:
    """Balanced pose with arms at rest at a pelvis height (m), clamped to the table's range."""
    row = stance_table().at(np.array([height]))
    x, y, pitch = row.pelvis[0]
    joints = np.zeros(NUM_JOINTS)
    joints[: WAIST.stop], joints[ARMS] = row.joints[0], REST.ravel()
    quaternion = np.array([np.cos(pitch / 2), 0.0, np.sin(pitch / 2), 0.0])
    clamped = float(stance_table().clamp(np.array(height)))
    return StandingPose(np.array([x, y, clamped]), quaternion, joints)
