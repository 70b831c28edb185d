"""A robot as its motors, its IMU and its camera: what a low-level controller drives.

`Robot` is what the planner sees of a robot; these are the parts beneath, for robots whose
low-level controller runs on our side of the wire.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BodyState:
    """One reading of joints and IMU."""

    time_ns: int
    """When it arrived, on the monotonic clock of this machine."""
    joint_position: Array
    """(29,) rad, ``spec.JOINT_NAMES`` order."""
    joint_velocity: Array
    """(29,) rad/s."""
    quaternion_w: Array
    """(4,) orientation of the pelvis, (w, x, y, z)."""
    angular_velocity: Array
    """(3,) rad/s, pelvis frame."""
    mode: int = 0
    """The robot's mode machine, which every command must repeat."""
    remote: bytes = b""
    """The operator's remote control as the robot relays it; empty: the robot has none."""
    motors: MotorReadings | None = None
    """Torque, temperature and status of the motors; None: the body does not report them."""


@dataclass(frozen=True)
class MotorCommand:
    """Servo targets: each motor applies stiffness * (position - q) - damping * dq."""

    position: Array
    """(29,) rad, ``spec.JOINT_NAMES`` order."""
    stiffness: Array
    """(29,) N m/rad; zeros leave damping only."""
    damping: Array
    """(29,) N m s/rad."""
    mode: int = 0
    """`BodyState.mode` of the newest reading."""


@dataclass(frozen=True)
class Picture:
    """One depth image."""

    time_ns: int
    """When it arrived, on the monotonic clock of this machine."""
    depth: NDArray[np.uint16]
    """(48, 64) planar depth, mm, 0 invalid."""
    taken_ns: int | None = None
    """When the camera's driver received it, on the same clock; the time of a network is not in it.
    None: the camera does not say."""


class Body(Protocol):
    """Motors and IMU. No call blocks."""

    def read(self) -> BodyState | None:
        """The newest reading; None before the first."""
        ...

    def write(self, command: MotorCommand) -> None:
        """Send servo targets; they hold until the next."""
        ...

    def close(self) -> None:
        """Release the connection; further calls do nothing."""
        ...


class Eye(Protocol):
    """A depth camera. No call blocks."""

    def read(self) -> Picture | None:
        """The newest picture; None before the first."""
        ...

    def close(self) -> None:
        """Release the camera; further calls do nothing."""
        ...
