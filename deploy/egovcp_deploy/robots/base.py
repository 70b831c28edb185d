"""Observations, readings and commands of robots.

`SimRobot` and `ReplayRobot` take planner actions and advance time themselves. `BridgeRobot`,
`ZmqDepthCamera` and `RealSenseDepthCamera` are the motors, IMU and camera of a robot on the wall
clock, whose low-level controller runs in our process; none of their reads blocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings
from egovcp.robot.g1 import EFFORT_LIMIT
from egovcp.robot.geometry import rotation_matrix
from egovcp.spec import COMMAND_SLICE, STATE_DIM, STATE_SLICES, Solid

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RobotObservation:
    """One observation o_t. A simulator adds the true poses, for logs only."""

    depth: NDArray[np.uint16]  # (48, 64) planar depth, mm, 0 invalid
    state: NDArray[np.float32]  # (74,) proprioception in the layout of `spec.STATE_SLICES`
    base: Array | None = None  # (7,) see `Tick`
    scene: tuple[Solid, ...] = ()


@dataclass(frozen=True)
class ActionResult:
    """Result of one action. A recording of a real robot contains only what was sent."""

    sent: Array  # (7,) the action that took effect, in [-1, 1]
    reward: float = 0.0
    reward_terms: Mapping[str, float] = field(default_factory=dict)
    terminated: bool = False
    truncated: bool = False
    success: bool = False
    parts: Mapping[str, bool] = field(default_factory=dict)  # success of each part of a sequence
    events: tuple[str, ...] = ()


@dataclass(frozen=True)
class LowState:
    """One reading of joints, IMU and remote control (Unitree's ``rt/lowstate``)."""

    time_ns: int  # time of arrival on this machine's monotonic clock
    joint_position: Array  # (29,) rad, ``spec.JOINT_NAMES`` order
    joint_velocity: Array  # (29,) rad/s
    quaternion_w: Array  # (4,) orientation of the pelvis, (w, x, y, z)
    angular_velocity: Array  # (3,) rad/s, pelvis frame
    mode: int = 0  # ``mode_machine``; every command must repeat it
    remote: bytes = b""  # message of the operator's remote control; empty if there is none
    motors: MotorReadings | None = None  # None if the robot does not report them


@dataclass(frozen=True)
class MotorCommand:
    """Joint targets: each motor applies stiffness * (position - q) - damping * dq."""

    position: Array  # (29,) rad, ``spec.JOINT_NAMES`` order
    stiffness: Array  # (29,) N m/rad; all zero: damping only
    damping: Array  # (29,) N m s/rad
    mode: int = 0  # `LowState.mode` of the newest reading

    def torque(self, reading: LowState) -> Array:
        """(29,) N m that the command requires at ``reading``, within the limits of the motors."""
        torque = self.stiffness * (self.position - reading.joint_position)
        torque -= self.damping * reading.joint_velocity
        return np.clip(torque, -EFFORT_LIMIT, EFFORT_LIMIT)


@dataclass(frozen=True)
class DepthImage:
    """One depth image."""

    time_ns: int  # time of arrival on this machine's monotonic clock
    depth: NDArray[np.uint16]  # (48, 64) planar depth, mm, 0 invalid
    captured_ns: int | None = None
    """Time at which the camera driver received it, on the same clock and without network delay;
    None if unknown."""


def proprioception(state: LowState, command: NDArray[np.floating]) -> Array:
    """Proprioception (74,) in the layout of `spec.STATE_SLICES`, of a reading and the last
    ``command`` sent (10,): velocity 3, hands 6 (m), height (m)."""
    out = np.empty(STATE_DIM)
    out[STATE_SLICES["angular_velocity"]] = state.angular_velocity
    out[STATE_SLICES["projected_gravity"]] = -rotation_matrix(state.quaternion_w)[2]
    out[COMMAND_SLICE] = command
    out[STATE_SLICES["joint_position"]] = state.joint_position
    out[STATE_SLICES["joint_velocity"]] = state.joint_velocity
    return out
