"""Low-level access to a G1 through LeRobot's bridge.

A thread receives, checks and time-stamps every reading; `BridgeRobot.read` returns the newest.
Commands are sent at once or dropped: none is queued until a robot returns.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
import zmq

from egovcp.bounds import bounded, check_bounds
from egovcp.errors import EnvironmentFailure
from egovcp.robot.g1 import EFFORT_LIMIT
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp_deploy.robots import wire
from egovcp_deploy.robots.base import Array, LowState, MotorCommand
from egovcp_deploy.robots.plausibility import PlausibilityFilter
from egovcp_deploy.robots.subscriber import (
    ArrivalMonitor,
    Subscriber,
    connect_socket,
    connection_error,
)

LISTEN_S: Final = 0.5  # s of readings before `CommandConflictDetector.refusal` can be empty
GAP_S: Final = 0.2  # a silence after which the statistics start again
_TIME_CONSTANT_S: Final = 0.3  # of each joint's average
#: Largest share of deviating readings of one motor; two equal publishers cause about one half.
_MAX_SHARE: Final = 0.35
_TOLERANCE: Final = np.maximum(1.0, 0.05 * EFFORT_LIMIT)  # N m
_RELATIVE_TOLERANCE: Final = 0.5  # gains and torque estimates are rough
_NO_COMMAND: Final = MotorCommand(np.zeros(NUM_JOINTS), np.zeros(NUM_JOINTS), np.zeros(NUM_JOINTS))

MODE_CHANGE_S: Final = 0.1  # shorter changes of the mode machine are ignored
#: Hardware by mode machine, from robots/g1_description/README.md of unitreerobotics/unitree_ros.
_JOINTS: Final = {1: 23, 4: 23, 9: 14, 10: 23} | dict.fromkeys((2, 3, 5, 6, *range(11, 17)), 29)
_WAIST_LOCKED: Final = (3, 6, 12, 14, 16)  # by its fastener and by the switch in Unitree's app
_HIP_GEAR_22: Final = (10, 11, 12, 15, 16)  # 22.5; the gains in `egovcp.robot.g1` are for 14.3
_START: Final = (
    "start it on the robot: python -m lerobot.robots.unitree_g1.run_g1_server; or without a "
    "robot, here: egovcp-fake-g1"
)


def mode_refusal(mode: int, confirmed: bool) -> str:
    """Why our controllers, which command all 29 joints, must not drive a robot with this mode
    machine; empty: they may. ``confirmed``: the user has named it and accepts a locked waist."""
    joints = _JOINTS.get(mode, 29)
    if joints != 29:
        return (
            f"mode machine {mode} is a G1 with {joints} joints; the controller commands 29: use a "
            "robot that has them"
        )
    if mode in _WAIST_LOCKED and not confirmed:
        return (
            f"mode machine {mode} is a G1 whose waist is locked, and the controller balances with "
            "waist roll and pitch: remove the fastener and switch the waist lock off in Unitree's "
            f"app, or accept it with --robot.bridge.mode={mode}"
        )
    return ""


def mode_warning(mode: int) -> str:
    """How a robot with this mode machine differs from what the controllers are made for; empty: it
    does not."""
    if mode not in _JOINTS:
        return f"mode machine {mode} is not known: 29 joints and a free waist are not checked"
    if mode in _WAIST_LOCKED:
        return f"mode machine {mode}: the waist is locked, and balance is untested without it"
    if mode in _HIP_GEAR_22:
        return f"mode machine {mode}: the hip pitch gear is 22.5, the gains are for 14.3; untested"
    return ""


@dataclass(frozen=True)
class BridgeConfig:
    """Connection to LeRobot's bridge."""

    host: str = "127.0.0.1"
    """Host of LeRobot's bridge: usually 192.168.123.164 for a G1, 127.0.0.1 for egovcp-fake-g1."""
    state_port: int = bounded(wire.STATE_PORT, least=1, most=65535)
    """Port for states."""
    command_port: int = bounded(wire.COMMAND_PORT, least=1, most=65535)
    """Port for commands."""
    mode: int | None = None
    """Required mode machine, which identifies the robot's variant; null: any with 29 joints and a
    free waist. To run with a locked waist, name its mode."""

    def __post_init__(self) -> None:
        check_bounds(self)


class CommandConflictDetector:
    """Detects whether another program commands the motors.

    LeRobot's bridge forwards the commands of all clients and does not identify them, but reports
    the torque of every motor. A motor that follows our commands applies `MotorCommand.torque`; one
    that keeps applying something else follows another program, the robot's own controller, or the
    last command of a program that has ended. A publisher whose commands need no torque, such as
    one that only damps a robot at rest, is not detected. Untested on hardware.
    """

    def __init__(self) -> None:
        self._command = _NO_COMMAND
        self._read_ns: int | None = None
        self._restart()

    def _restart(self) -> None:
        self._deviating: Array = np.zeros(NUM_JOINTS)  # share of the readings
        self._listened_s = 0.0

    def record_command(self, command: MotorCommand) -> None:
        """Record a command that was sent."""
        self._command = command

    def update(self, state: LowState) -> None:
        """Process the next reading."""
        assert state.motors is not None, "every rt/lowstate has torques"
        now = state.time_ns
        elapsed = math.inf if self._read_ns is None else (now - self._read_ns) / 1e9
        self._read_ns = now
        if elapsed > GAP_S:
            self._restart()
            return
        expected = self._command.torque(state)
        tolerance = _TOLERANCE + _RELATIVE_TOLERANCE * np.abs(expected)
        deviates = np.abs(state.motors.torque - expected) > tolerance
        self._deviating += (deviates - self._deviating) * (
            1.0 - math.exp(-elapsed / _TIME_CONSTANT_S)
        )
        self._listened_s += elapsed

    @property
    def refusal(self) -> str:
        """Why the robot must not be armed; empty: no other publisher within `LISTEN_S`."""
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


class BridgeRobot:
    """Motors and IMU of a G1 over LeRobot's bridge. Call `connect` first; no other call blocks."""

    def __init__(self, config: BridgeConfig | None = None) -> None:
        self.config = config or BridgeConfig()
        self.arrivals = ArrivalMonitor()
        """Arrivals of usable readings; unusable messages count as lost."""
        self._conflicts = CommandConflictDetector()
        self._filter = PlausibilityFilter()
        self._newest: LowState | None = None
        self._payload = b""
        self._mode: int | None = None  # of the first reading
        self._mode_changed_ns: int | None = None
        self._malformed = 0  # messages that are not states
        self._implausible = 0  # rejected readings that no G1 can produce (`plausibility`)
        self._rejected = 0  # readings since the newest usable one
        self._rejection = ""
        self._subscriber: Subscriber | None = None

    def connect(self, timeout: float = 5.0) -> Self:
        """Wait up to ``timeout`` s for the first reading; returns itself. Raises
        `EnvironmentFailure` if none arrived, or one of an unexpected robot."""
        self._open()
        deadline = time.monotonic() + timeout
        while self._newest is None and time.monotonic() < deadline:
            time.sleep(0.005)
        newest, confirmed = self._newest, self.config.mode is not None
        if newest is None:
            problem = self._timeout_reason(timeout)
        else:
            problem = self._unexpected_mode() or mode_refusal(newest.mode, confirmed)
        if problem:
            self.close()
            raise EnvironmentFailure(problem)
        return self

    def _open(self) -> None:
        config = self.config
        self._context = zmq.Context()
        self._commands = self._context.socket(zmq.PUSH)
        self._commands.setsockopt(zmq.CONFLATE, 1)  # a newer command replaces a queued one
        self._commands.setsockopt(zmq.IMMEDIATE, 1)  # nothing is queued without a connection
        try:
            connect_socket(self._commands, config.host, config.command_port)
            self._subscriber = Subscriber(
                config.host, config.state_port, wire.MAX_BYTES, self._handle, self._reject_message
            )
        except EnvironmentFailure:
            self._context.destroy(linger=0)
            raise

    def stop_receiving(self) -> None:
        """Stop the receiving thread; `write` still works, and `read` keeps the last reading."""
        assert self._subscriber is not None, "connect first"
        self._subscriber.close()

    def _handle(self, payload: bytes, time_ns: int, older: int) -> bool:
        """Process a message that arrived at ``time_ns``; whether it is a usable reading. Raises
        `wire.MalformedMessage`."""
        if payload == self._payload:  # sensor noise never repeats: the driver is stuck
            return False
        self._payload = payload
        state = wire.decode_state(payload, time_ns)
        if problem := self._filter.check(state):
            self._implausible += 1
            self._reject(problem, time_ns)
            return False
        self.arrivals.record_arrival(time_ns)
        self._conflicts.update(state)
        if self._mode is None:
            self._mode = state.mode
        if state.mode == self._mode:
            self._mode_changed_ns = None
        elif self._mode_changed_ns is None:
            self._mode_changed_ns = time_ns
        self._newest = state
        self._rejected = 0
        return True

    def _reject_message(self, problem: str, time_ns: int) -> None:
        self._malformed += 1
        self._reject(problem, time_ns)

    def _reject(self, problem: str, time_ns: int) -> None:
        self.arrivals.record_loss(time_ns)
        self._rejected += 1
        self._rejection = problem

    def read(self) -> LowState | None:
        """Return the newest reading, None before the first; its time is its time of arrival."""
        return self._newest

    def write(self, command: MotorCommand) -> None:
        """Send joint targets, which hold until the next command; drops a command that no motor
        could follow, and every command while no bridge is connected."""
        try:
            self._commands.send(wire.encode_command(command), zmq.NOBLOCK)
        except (wire.MalformedMessage, zmq.Again):
            return
        self._conflicts.record_command(command)

    @property
    def refusal(self) -> str:
        """Why the robot must not be armed now, because of its mode machine or other commands;
        empty: no reason."""
        return self._unexpected_mode() or self._conflicts.refusal

    @property
    def fault(self) -> str:
        """Why the motors must be damped; empty: no reason. The mode machine has differed from the
        first one for `MODE_CHANGE_S`: the robot does not match the controller's assumptions any
        more, or has left low-level control."""
        newest, since = self._newest, self._mode_changed_ns
        if newest is None or since is None or newest.time_ns - since < MODE_CHANGE_S * 1e9:
            return ""
        return f"the mode machine changed from {self._mode} to {newest.mode}"

    @property
    def rejected(self) -> str:
        """Number and reason of the readings rejected since the newest one; empty: none."""
        count = self._rejected
        return f"{count} readings rejected, the last: {self._rejection}" if count else ""

    @property
    def warning(self) -> str:
        """Warning for the operator of this robot; empty: none."""
        return "" if self._newest is None else mode_warning(self._newest.mode)

    def _unexpected_mode(self) -> str:
        found = self._newest.mode if self._newest else None
        expected = self._mode if self.config.mode is None else self.config.mode
        if found == expected:
            return ""
        return (
            f"the robot reports mode machine {found}, expected {expected}; it is another robot, "
            "or in another mode: check it, then start again"
        )

    def _timeout_reason(self, timeout: float) -> str:
        """Why no reading arrived."""
        where = f"{self.config.host}:{self.config.state_port}"
        if self._malformed:
            return (
                f"{self._malformed} messages from {where}, none a state of a G1: "
                f"{self._rejection}; expected LeRobot's bridge there, of lerobot 0.6"
            )
        if self._implausible:
            return (
                f"{self._implausible} states from {where}, none that a G1 can be in: "
                f"{self._rejection}; check the robot's sensors and joints"
            )
        if reason := connection_error(self.config.host, self.config.state_port):
            return f"nothing at {where} ({reason}): expected LeRobot's bridge; {_START}"
        return (
            f"no state from {where} within {timeout:g} s, although something listens there; "
            f"expected LeRobot's bridge, and a robot that is switched on; {_START}"
        )

    def close(self) -> None:
        """Stop the thread and close the sockets; may be called more than once. Sends nothing: the
        motors keep their last command."""
        if self._subscriber is None or self._commands.closed:
            return
        self._subscriber.close()
        self._commands.close()
        self._context.term()
