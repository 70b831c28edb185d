"""Detects whether another program commands the motors.

LeRobot's bridge forwards the commands of all clients and does not identify them. It does
report the torque of every motor. A motor that follows our commands applies

    kp (q* - q) - kd dq        with q*, kp, kd as sent, all zero before the first command

within its effort limit. A motor that keeps applying something else follows another program, the
robot's own controller, or the last command of a program that has ended.

A second publisher whose commands need no torque, such as one that only damps a robot at rest, is
not detected. A bridge that counts its clients reports them in ``command_sources``. Untested on
hardware.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.g1 import EFFORT_LIMIT
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp_deploy.robots.base import LowState, MotorCommand

Array = NDArray[np.float64]

LISTEN_S: Final = 0.5  # readings that are needed for a result
GAP_S: Final = 0.2  # a silence after which the statistics start again
_TIME_CONSTANT_S: Final = 0.3  # of each joint's average
_MAX_SHARE: Final = 0.35  # of deviating readings; two equal publishers cause about one half
_TOLERANCE: Final = np.maximum(1.0, 0.05 * EFFORT_LIMIT)  # N m
_RELATIVE_TOLERANCE: Final = 0.5  # gains and torque estimates are rough
_COUNTED_S: Final = 1.0  # a bridge may count us for this long after our last command
_NO_COMMAND: Final = MotorCommand(np.zeros(NUM_JOINTS), np.zeros(NUM_JOINTS), np.zeros(NUM_JOINTS))


class CommandConflictDetector:
    """Compares measured torques with those of our own commands."""

    def __init__(self) -> None:
        self._command = _NO_COMMAND
        self._sent_ns: int | None = None
        self._read_ns: int | None = None
        self._other_sources = 0
        self._restart()

    def _restart(self) -> None:
        self._deviating: Array = np.zeros(NUM_JOINTS)  # share of the readings
        self._listened_s = 0.0

    def record_command(self, command: MotorCommand, time_ns: int) -> None:
        """Record a command that was sent at ``time_ns``."""
        self._command, self._sent_ns = command, time_ns

    def update(self, state: LowState) -> None:
        """Process the next reading."""
        assert state.motors is not None, "every rt/lowstate has torques"
        now = state.time_ns
        elapsed = math.inf if self._read_ns is None else (now - self._read_ns) / 1e9
        self._read_ns = now
        ours = self._sent_ns is not None and now - self._sent_ns < _COUNTED_S * 1e9
        self._other_sources = (state.command_sources or 0) - ours
        if elapsed > GAP_S:
            self._restart()
            return
        expected = self._expected_torque(state)
        tolerance = _TOLERANCE + _RELATIVE_TOLERANCE * np.abs(expected)
        deviates = np.abs(state.motors.torque - expected) > tolerance
        self._deviating += (deviates - self._deviating) * (
            1.0 - math.exp(-elapsed / _TIME_CONSTANT_S)
        )
        self._listened_s += elapsed

    def _expected_torque(self, state: LowState) -> Array:
        """(29,) N m if every motor follows our command."""
        sent = self._command
        torque = sent.stiffness * (sent.position - state.joint_position)
        torque -= sent.damping * state.joint_velocity
        return np.clip(torque, -EFFORT_LIMIT, EFFORT_LIMIT)

    @property
    def refusal(self) -> str:
        """Why the robot must not be armed; empty: no other publisher within `LISTEN_S`."""
        if self._other_sources > 0:
            return f"{self._other_sources} other program(s) send commands to the robot; stop them"
        if self._listened_s < LISTEN_S:
            return f"still listening for other publishers: {self._listened_s:.1f} of {LISTEN_S} s"
        joint = int(np.argmax(self._deviating))
        if self._deviating[joint] > _MAX_SHARE:
            return (
                f"the motor of {JOINT_NAMES[joint]} does not follow our commands: another program, "
                "the robot's own controller, or the last command of a program that has ended "
                "drives it; stop it, and damp the robot with its remote control"
            )
        return ""
