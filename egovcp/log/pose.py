"""World poses of the robot's links, its camera and its hand targets at a tick.

In simulation the pelvis pose is exact. On a real robot the pelvis is drawn at the origin, at its
commanded height, with the tilt of the IMU, heading along x.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import CameraView, Tick
from egovcp.robot.geometry import heading_rotation, quaternion, rotate, rotation_matrix
from egovcp.robot.kinematics import LINK_NAMES, PALM_OFFSET, WRISTS, link_transforms
from egovcp.spec import STATE_SLICES

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RobotPose:
    """Poses of every link, the camera and the heading frame in the world."""

    positions_w: Array
    """(L, 3) m, in the order of `LINK_NAMES`."""
    rotations_w: Array
    """(L, 3, 3)."""
    heading_w: Array
    """(3, 3) rotation of the pelvis heading frame: yaw only."""
    palms_w: Array
    """(2, 3) palm sites, left then right, m."""

    @property
    def quaternions_w(self) -> Array:
        """(L, 4) unit quaternions (w, x, y, z)."""
        return quaternion(self.rotations_w)

    def from_heading(self, points_b: NDArray[np.floating]) -> Array:
        """(..., 3) points of the pelvis heading frame -> world, m."""
        out: Array = self.positions_w[0] + np.asarray(points_b, np.float64) @ self.heading_w.T
        return out

    def camera(self, view: CameraView) -> tuple[Array, Array]:
        """Optical frame (x right, y down, z forward) in the world: (3,) m and (3, 3)."""
        link = LINK_NAMES.index(view.link)
        rotation = self.rotations_w[link]
        return self.positions_w[link] + rotation @ view.position, rotation @ view.rotation


def robot_pose(tick: Tick) -> RobotPose:
    """Forward kinematics of ``tick``'s measured joints on its pelvis pose."""
    return robot_poses([tick])[0]


def robot_poses(ticks: Sequence[Tick]) -> list[RobotPose]:
    """`robot_pose` of several ticks at once, about as fast as of one."""
    states = np.stack([tick.state for tick in ticks]).astype(np.float64)
    positions, rotations = link_transforms(states[:, STATE_SLICES["joint_position"]])
    tilts = heading_rotation(states[:, STATE_SLICES["projected_gravity"]])
    heights = states[:, STATE_SLICES["command_height"]]
    return [
        _place(tick, heights[i].item(), tilts[i], positions[i], rotations[i])
        for i, tick in enumerate(ticks)
    ]


def _place(tick: Tick, height: float, tilt: Array, positions: Array, rotations: Array) -> RobotPose:
    """Link poses in the pelvis frame -> in the world."""
    if tick.base is None:
        origin, pelvis = np.array([0.0, 0.0, height]), tilt
    else:
        origin = np.asarray(tick.base[:3], np.float64)
        pelvis = rotation_matrix(tick.base[3:])
    positions_w = origin + positions @ pelvis.T
    rotations_w = pelvis @ rotations
    palms = positions_w[WRISTS] + rotate(rotations_w[WRISTS], PALM_OFFSET)
    return RobotPose(positions_w, rotations_w, _yaw_only(pelvis), palms)


def _yaw_only(rotation: Array) -> Array:
    """The heading of ``rotation`` (3, 3): its x axis made horizontal, z up."""
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
