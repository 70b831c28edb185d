"""Low-level access to a G1 through LeRobot's bridge.

A thread receives, checks and time-stamps every reading; `BridgeRobot.read` returns the newest.
Commands are sent at once or dropped: none is queued until a robot returns.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

import zmq

from egovcp.bounds import bounded, check_bounds
from egovcp.errors import EnvironmentFailure
from egovcp_deploy.robots.base import LowState, MotorCommand
from egovcp_deploy.robots.command_conflict import CommandConflictDetector
from egovcp_deploy.robots.g1_variants import variant_refusal, variant_warning
from egovcp_deploy.robots.plausibility import PlausibilityFilter
from egovcp_deploy.robots.subscriber import (
    ArrivalMonitor,
    Subscriber,
    connect_socket,
    connection_error,
)
from egovcp_deploy.robots.wire import (
    COMMAND_PORT,
    MAX_BYTES,
    STATE_PORT,
    MalformedMessage,
    decode_state,
    encode_command,
)

MODE_CHANGE_S: Final = 0.1  # shorter changes of the mode machine are ignored
_START: Final = (
    "start it on the robot: python -m lerobot.robots.unitree_g1.run_g1_server; or without a "
    "robot, here: egovcp-fake-g1"
)


@dataclass(frozen=True)
class BridgeConfig:
    """Connection to LeRobot's bridge."""

    host: str = "127.0.0.1"
    """Host of LeRobot's bridge: usually 192.168.123.164 for a G1, 127.0.0.1 for egovcp-fake-g1."""
    state_port: int = bounded(STATE_PORT, least=1, most=65535)
    """Port for states."""
    command_port: int = bounded(COMMAND_PORT, least=1, most=65535)
    """Port for commands."""
    mode: int | None = None
    """Required mode machine, which identifies the robot's variant; null: any with 29 joints and a
    free waist. Naming a mode with a locked waist accepts it."""
    consistency: bool = True
    """Reject readings whose positions and speeds contradict each other. Bounds are always
    checked."""

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass
class BridgeCounters:
    """Messages received and sent."""

    readings: int = 0
    implausible: int = 0
    """Rejected readings that no G1 can produce (`plausibility`)."""
    repeated: int = 0
    """Readings identical to the last one: sensor noise never repeats, so the driver is stuck."""
    malformed: int = 0
    """Messages that are not states."""
    sent: int = 0
    dropped: int = 0
    """Commands that were not sent because no bridge was connected."""
    invalid: int = 0
    """Commands that were not sent because no motor could follow them."""
    problem: str = ""
    """Reason for the last rejected reading or command."""


class BridgeRobot:
    """`LowLevelRobot` over LeRobot's bridge. Call `connect` first."""

    def __init__(self, config: BridgeConfig | None = None) -> None:
        self.config = config or BridgeConfig()
        self.counters = BridgeCounters()
        self.arrivals = ArrivalMonitor()
        """Arrivals of usable readings; unusable messages count as lost."""
        self._conflicts = CommandConflictDetector()
        self._filter = PlausibilityFilter(self.config.consistency)
        self._newest: LowState | None = None
        self._payload = b""
        self._mode: int | None = None  # of the first reading
        self._mode_changed_ns: int | None = None
        self._rejected = 0  # readings since the newest usable one
        self._rejection = ""
        self._subscriber: Subscriber | None = None

    def connect(self, timeout: float = 5.0) -> None:
        """Wait up to ``timeout`` s for the first reading.

        Raises:
            EnvironmentFailure: no reading arrived, or it is of an unexpected robot.
        """
        self._open()
        deadline = time.monotonic() + timeout
        while self._newest is None and time.monotonic() < deadline:
            time.sleep(0.005)
        newest, confirmed = self._newest, self.config.mode is not None
        if newest is None:
            problem = self._timeout_reason(timeout)
        else:
            problem = self._unexpected_mode() or variant_refusal(newest.mode, confirmed)
        if problem:
            self.close()
            raise EnvironmentFailure(problem)

    def _open(self) -> None:
        config = self.config
        self._context = zmq.Context()
        self._commands = self._context.socket(zmq.PUSH)
        self._commands.setsockopt(zmq.CONFLATE, 1)  # a newer command replaces a queued one
        self._commands.setsockopt(zmq.IMMEDIATE, 1)  # nothing is queued without a connection
        try:
            connect_socket(self._commands, config.host, config.command_port)
            self._subscriber = Subscriber(config.host, config.state_port, MAX_BYTES, self._handle)
        except EnvironmentFailure:
            self._context.destroy(linger=0)
            raise

    def stop_receiving(self) -> None:
        """Stop the receiving thread; `write` still works, and `read` keeps the last reading."""
        assert self._subscriber is not None, "connect first"
        self._subscriber.close()

    def _handle(self, payload: bytes, time_ns: int) -> bool:
        """Process a message that arrived at ``time_ns``; whether it is a usable reading."""
        if payload == self._payload:
            self.counters.repeated += 1
            return False
        self._payload = payload
        try:
            state = decode_state(payload, time_ns)
        except MalformedMessage as error:
            self.counters.malformed += 1
            self._reject(str(error), time_ns)
            return False
        if problem := self._filter.check(state):
            self.counters.implausible += 1
            self._reject(problem, time_ns)
            return False
        self.counters.readings += 1
        self.arrivals.record_arrival(time_ns)
        self._conflicts.update(state)
        self._track_mode(state)
        self._newest = state
        self._rejected = 0
        return True

    def _reject(self, problem: str, time_ns: int) -> None:
        self.arrivals.record_loss(time_ns)
        self._rejected += 1
        self._rejection = self.counters.problem = problem

    def _track_mode(self, state: LowState) -> None:
        if self._mode is None:
            self._mode = state.mode
        if state.mode == self._mode:
            self._mode_changed_ns = None
        elif self._mode_changed_ns is None:
            self._mode_changed_ns = state.time_ns

    def read(self) -> LowState | None:
        """Return the newest reading; its time is its time of arrival."""
        return self._newest

    def write(self, command: MotorCommand) -> None:
        """Send joint targets; a command that cannot be sent is counted in `counters`."""
        try:
            self._commands.send(encode_command(command), zmq.NOBLOCK)
        except MalformedMessage as error:
            self.counters.invalid += 1
            self.counters.problem = str(error)
        except zmq.Again:
            self.counters.dropped += 1
        else:
            self.counters.sent += 1
            self._conflicts.record_command(command, time.monotonic_ns())

    @property
    def refusal(self) -> str:
        """Why the robot must not be armed now; empty: no reason.

        An unexpected mode machine, or motors that follow other commands (`command_conflict`).
        """
        return self._unexpected_mode() or self._conflicts.refusal

    @property
    def fault(self) -> str:
        """Why the motors must be damped; empty: no reason.

        The mode machine has differed from the first one for `MODE_CHANGE_S`: the robot does not
        match the controller's assumptions any more, or has left low-level control.
        """
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
        return "" if self._newest is None else variant_warning(self._newest.mode)

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
        counters = self.counters
        where = f"{self.config.host}:{self.config.state_port}"
        if counters.malformed:
            return (
                f"{counters.malformed} messages from {where}, none a state of a G1: "
                f"{counters.problem}; expected LeRobot's bridge there, of lerobot 0.6"
            )
        if counters.implausible:
            return (
                f"{counters.implausible} states from {where}, none that a G1 can be in: "
                f"{counters.problem}; check the robot's sensors and joints"
            )
        if reason := connection_error(self.config.host, self.config.state_port):
            return f"nothing at {where} ({reason}): expected LeRobot's bridge; {_START}"
        return (
            f"no state from {where} within {timeout:g} s, although something listens there; "
            f"expected LeRobot's bridge, and a robot that is switched on; {_START}"
        )

    def close(self) -> None:
        """Stop the thread and close the sockets; may be called more than once.

        Sends nothing: the motors keep their last command.
        """
        if self._subscriber is None or self._commands.closed:
            return
        self._subscriber.close()
        self._commands.close()
        self._context.term()
