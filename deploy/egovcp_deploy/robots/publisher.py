"""Does somebody else command the motors?

LeRobot's bridge passes on what any client sends, says to nobody who they are, and echoes no
command. What it does tell is the torque of every motor, and that gives others away: a motor that
obeys us applies

    kp (q* - q) - kd dq        with q*, kp, kd as we sent them, all zero before we sent any

within the motor's limit. One that goes on doing something else obeys somebody else, be it another
program, the robot's own controller, or the last command of a program that has ended.

This cannot see a second publisher whose commands happen to need no torque, such as one that only
damps a robot at rest: it is a reason to refuse, and its silence no proof. A bridge that counts its
clients says so in ``command_sources``, and then there is no doubt. Untested on hardware.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.g1 import EFFORT_LIMIT
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp_deploy.robots.body import MotorCommand
from egovcp_deploy.robots.wire import LowState

Array = NDArray[np.float64]

LISTEN_S: Final = 0.5  # how long before there is a verdict
_MEMORY_S: Final = 0.3  # time constant of each joint's average
_SHARE: Final = 0.35  # of the readings; two who send equally often get half of them each
_SLACK: Final = np.maximum(1.0, 0.05 * EFFORT_LIMIT)  # N m
_RELATIVE: Final = 0.5  # of the expected torque: gains and estimates are rough
GAP_S: Final = 0.2  # a silence after which listening starts again
_OURS_S: Final = 1.0  # how long a bridge may still count us after our last command
_QUIET: Final = MotorCommand(np.zeros(NUM_JOINTS), np.zeros(NUM_JOINTS), np.zeros(NUM_JOINTS))


class PublisherWatch:
    """Compares what the motors do with what we told them."""

    def __init__(self) -> None:
        self._told = _QUIET
        self._sent_ns: int | None = None
        self._restart()
        self._heard_ns: int | None = None
        self._strangers = 0

    def _restart(self) -> None:
        self._astray: Array = np.zeros(NUM_JOINTS)
        self._listened_s = 0.0

    def sent(self, command: MotorCommand, time_ns: int) -> None:
        """We have told the motors ``command``."""
        self._told, self._sent_ns = command, time_ns

    def heard(self, state: LowState) -> None:
        """The next reading."""
        now = state.body.time_ns
        elapsed = math.inf if self._heard_ns is None else (now - self._heard_ns) / 1e9
        self._heard_ns = now
        self._count_strangers(state.sources or 0, now)
        if elapsed > GAP_S:
            self._restart()
            return
        wrong = np.abs(state.motors.torque - self._expected(state)) > self._slack(state)
        self._astray += (wrong - self._astray) * (1.0 - math.exp(-elapsed / _MEMORY_S))
        self._listened_s += elapsed

    def _count_strangers(self, sources: int, now: int) -> None:
        ours = self._sent_ns is not None and now - self._sent_ns < _OURS_S * 1e9
        self._strangers = sources - ours

    def _expected(self, state: LowState) -> Array:
        """(29,) N m if every motor obeys us."""
        told, body = self._told, state.body
        torque = told.stiffness * (told.position - body.joint_position)
        torque -= told.damping * body.joint_velocity
        return np.clip(torque, -EFFORT_LIMIT, EFFORT_LIMIT)

    def _slack(self, state: LowState) -> Array:
        return np.asarray(_SLACK + _RELATIVE * np.abs(self._expected(state)))

    @property
    def verdict(self) -> str:
        """Why the robot must not be armed; empty: nobody else was noticed in `LISTEN_S`."""
        if self._strangers > 0:
            return f"{self._strangers} other program(s) send commands to the robot; end them"
        if self._listened_s < LISTEN_S:
            return f"still listening for other publishers: {self._listened_s:.1f} of {LISTEN_S} s"
        joint = int(np.argmax(self._astray))
        if self._astray[joint] > _SHARE:
            return (
                f"the motor of {JOINT_NAMES[joint]} obeys somebody else: another program, the "
                "robot's own controller, or the last command of a program that has ended; end "
                "it, and damp the robot with its remote control"
            )
        return ""
