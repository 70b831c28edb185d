"""The simulator's truth about a batch of robots, for oracles, probes and logs only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.sim.lane import Lane
from egovcp.sim.tasks.base import Solid

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """State of all rows at a planner tick. ``_w`` world, ``_b`` pelvis heading frame."""

    task: tuple[str, ...]
    """(B,) the task that is played now; in a sequence it changes."""
    time: Array
    """(B,) s since the start of the episode."""
    since_event: Array
    """(B,) s since throw, push or start of the arch; negative before, -inf if there is none."""
    pelvis_w: Array
    """(B, 7) position m, quaternion wxyz."""
    pelvis_velocity_w: Array
    """(B, 3) m/s."""
    joint_position: Array
    """(B, J) rad, without sensor noise."""
    joint_velocity: Array
    """(B, J) rad/s, without sensor noise."""
    hands_w: Array
    """(B, 2, 3) palm sites, left and right, m."""
    hands_b: Array
    """(B, 2, 3) palm sites, m."""
    object_w: Array
    """(B, 3) ball centre (NaN before the throw), point of the wall nearest to the pelvis'
    x axis, or arch centre on the ground, m."""
    object_b: Array
    """(B, 3) the same, m."""
    object_velocity_w: Array
    """(B, 3) m/s."""
    object_velocity_b: Array
    """(B, 3) in the axes of the heading frame, not relative to the pelvis, m/s."""
    object_size: Array
    """(B,) ball radius or arch clearance, m; NaN for a wall."""
    object_active: NDArray[np.bool_]
    """(B,) ball in flight and untouched, push still felt, arch on the move."""
    contact_force: Array
    """(B, parts) peak force between each of ``scene.PARTS`` and the object in the last
    planner tick, N."""
    body_position_w: Array
    """(B, N, 3) robot bodies in the order of ``body_names``, m."""
    body_quaternion_w: Array
    """(B, N, 4) wxyz."""
    body_names: tuple[str, ...]
    """Names of the N robot bodies, as in the MJCF."""
    camera_w: Array
    """(B, 7) position m, quaternion wxyz; x is the optical axis, y left, z up."""
    solids: tuple[tuple[Solid, ...], ...]
    """Per row, what stands in the scene."""


def snapshot(lanes: Sequence[Lane]) -> Truth:
    """Collect the truth of all rows."""
    states = [lane.task.state() for lane in lanes]
    datas = [lane.robot.data for lane in lanes]
    index = lanes[0].robot.index
    position = np.array([state.position_w for state in states])
    velocity = np.array([state.velocity_w for state in states])
    hands = np.array([lane.robot.palms_w for lane in lanes])
    heading = np.array([lane.robot.heading for lane in lanes])
    pelvis = np.array([data.qpos[:7] for data in datas])
    bodies = [lane.robot.index.robot_bodies for lane in lanes]
    return Truth(
        task=tuple(lane.task.present for lane in lanes),
        time=np.array([lane.task.time for lane in lanes]),
        since_event=np.array([lane.task.since_event for lane in lanes]),
        pelvis_w=pelvis,
        pelvis_velocity_w=np.array([data.qvel[:3] for data in datas]),
        joint_position=np.array([d.qpos[index.joint_qpos] for d in datas]),
        joint_velocity=np.array([d.qvel[index.joint_qvel] for d in datas]),
        hands_w=hands,
        hands_b=np.einsum("bhi,bij->bhj", hands - pelvis[:, None, :3], heading),
        object_w=position,
        object_b=np.einsum("bi,bij->bj", position - pelvis[:, :3], heading),
        object_velocity_w=velocity,
        object_velocity_b=np.einsum("bi,bij->bj", velocity, heading),
        object_size=np.array([state.size for state in states]),
        object_active=np.array([state.active for state in states]),
        contact_force=np.array([lane.task.forces for lane in lanes]),
        body_position_w=np.array([d.xpos[b] for d, b in zip(datas, bodies, strict=True)]),
        body_quaternion_w=np.array([d.xquat[b] for d, b in zip(datas, bodies, strict=True)]),
        body_names=index.body_names,
        camera_w=np.array([_camera_pose(lane) for lane in lanes]),
        solids=tuple(lane.task.solids() for lane in lanes),
    )


def _camera_pose(lane: Lane) -> Array:
    position, rotation = lane.camera_pose
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    return np.concatenate([position, quaternion])
