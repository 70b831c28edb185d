"""The G1 behind LeRobot's bridge: a `Body` whose motors are at the other end of a wire.

A thread of its own receives, checks and time-stamps every reading; `BridgeBody.read` only looks
at the newest. Commands go out at once or not at all: none waits for a robot to come back.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

import numpy as np
import zmq

from egovcp.bounds import bounded, check_bounds
from egovcp.errors import EnvironmentFailure
from egovcp_deploy.robots.arrivals import Arrivals
from egovcp_deploy.robots.body import BodyState, MotorCommand
from egovcp_deploy.robots.listener import Listener, join, probe
from egovcp_deploy.robots.machine import objection, warning
from egovcp_deploy.robots.plausibility import PlausibilityFilter
from egovcp_deploy.robots.publisher import PublisherWatch
from egovcp_deploy.robots.wire import (
    COMMAND_PORT,
    MOST_BYTES,
    STATE_PORT,
    Garbled,
    decode_state,
    encode_command,
)

_START: Final = (
    "start it on the robot: python -m lerobot.robots.unitree_g1.run_g1_server; or without a "
    "robot, here: egovcp-fake-g1"
)


MODE_CHANGE_S: Final = 0.1  # a single reading with another mode is not believed


@dataclass(frozen=True)
class BridgeConfig:
    """Where the robot is."""

    host: str = "127.0.0.1"
    """Where LeRobot's bridge runs; a G1 is 192.168.123.164 unless told otherwise, egovcp-fake-g1
    is here."""
    state_port: int = bounded(STATE_PORT, least=1, most=65535)
    """Its port for states."""
    command_port: int = bounded(COMMAND_PORT, least=1, most=65535)
    """Its port for commands."""
    mode: int | None = None
    """Mode machine that the robot must report, which tells its hardware; null: any with 29 joints
    and a free waist. Naming one with a locked waist accepts it."""
    consistency: bool = True
    """Reject readings whose positions and speeds contradict each other. Bounds are always on."""

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass
class Traffic:
    """What has passed over the wire."""

    readings: int = 0
    implausible: int = 0
    """Readings that no G1 can produce (`plausibility`); none was used."""
    repeated: int = 0
    """Readings equal to the last, bit for bit: noise never repeats, so the driver is stuck."""
    garbled: int = 0
    """Messages that made no sense."""
    problem: str = ""
    """What was wrong with the last of them."""
    sent: int = 0
    dropped: int = 0
    """Commands not sent, for nobody was there to take them."""
    refused: int = 0
    """Commands not sent, for no motor could follow them."""


class BridgeBody:
    """`Body` over LeRobot's bridge. Call `connect` first."""

    def __init__(self, config: BridgeConfig | None = None) -> None:
        self.config = config or BridgeConfig()
        self.traffic = Traffic()
        self.watch = PublisherWatch()
        self.arrivals = Arrivals()
        """Of usable readings; messages that are not usable count as lost."""
        self._filter = PlausibilityFilter(self.config.consistency)
        self._newest: BodyState | None = None
        self._payload = b""
        self._mode: int | None = None
        self._other_mode_ns: int | None = None  # since when another mode has been reported
        self._skipped = 0  # readings since the newest that was used
        self._why_skipped = ""
        self._listener: Listener | None = None

    def connect(self, timeout: float = 5.0) -> None:
        """Wait for the first reading.

        Raises:
            EnvironmentFailure: none came within ``timeout`` s, or the robot is another.
        """
        self._open()
        deadline = time.monotonic() + timeout
        while self._newest is None and time.monotonic() < deadline:
            time.sleep(0.005)
        try:
            if self._newest is None:
                raise EnvironmentFailure(self._diagnosis(timeout))
            if trouble := self._mode_trouble() or self._machine_trouble():
                raise EnvironmentFailure(trouble)
        except EnvironmentFailure:
            self.close()
            raise

    def _open(self) -> None:
        config = self.config
        self._context = zmq.Context()
        self._commands = self._context.socket(zmq.PUSH)
        self._commands.setsockopt(zmq.CONFLATE, 1)  # a newer command replaces one that waits
        self._commands.setsockopt(zmq.IMMEDIATE, 1)  # and none waits for a peer that is not there
        try:
            join(self._commands, config.host, config.command_port)
            self._listener = Listener(config.host, config.state_port, MOST_BYTES, self._take)
        except EnvironmentFailure:
            self._context.destroy(linger=0)
            raise

    def deafen(self) -> None:
        """Listen no more: what is left is the way to the motors, and the last reading."""
        assert self._listener is not None, "connect first"
        self._listener.close()

    def _take(self, payload: bytes, time_ns: int) -> bool:
        """A message that arrived at ``time_ns``; whether it is a usable reading."""
        if payload == self._payload:
            self.traffic.repeated += 1
            return False
        self._payload = payload
        try:
            state = decode_state(payload, time_ns)
        except Garbled as error:
            self.traffic.garbled += 1
            self._skip(str(error), time_ns)
            return False
        if problem := self._filter.judge(state.body, np.asarray(state.motors.torque, np.float64)):
            self.traffic.implausible += 1
            self._skip(problem, time_ns)
            return False
        self.traffic.readings += 1
        self.arrivals.arrived(time_ns)
        self.watch.heard(state)
        self._watch_mode(state.body)
        self._newest = state.body
        self._skipped = 0
        return True

    def _skip(self, problem: str, time_ns: int) -> None:
        self.arrivals.lost(time_ns)
        self._skipped += 1
        self._why_skipped = self.traffic.problem = problem

    def _watch_mode(self, body: BodyState) -> None:
        if self._mode is None:
            self._mode = body.mode
        if body.mode == self._mode:
            self._other_mode_ns = None
        elif self._other_mode_ns is None:
            self._other_mode_ns = body.time_ns

    def read(self) -> BodyState | None:
        """The newest reading; its time is that of its arrival, whenever it is read."""
        return self._newest

    def write(self, command: MotorCommand) -> None:
        """Send servo targets, or count why not: see `traffic`."""
        try:
            payload = encode_command(command)
        except Garbled as error:
            self.traffic.refused += 1
            self.traffic.problem = str(error)
            return
        try:
            self._commands.send(payload, zmq.NOBLOCK)
        except zmq.Again:
            self.traffic.dropped += 1
            return
        self.traffic.sent += 1
        self.watch.sent(command, time.monotonic_ns())

    @property
    def trouble(self) -> str:
        """Why the robot must not be armed now, in words; empty: nothing is known against it.

        Another robot or mode than expected, or motors that obey somebody else (see `publisher`).
        """
        return self._mode_trouble() or self.watch.verdict

    @property
    def fault(self) -> str:
        """Why the motors must be damped, in words; empty: nothing.

        The mode machine has been another than at the start for `MODE_CHANGE_S`: the robot no
        longer is what the controller assumes, or has left low-level control.
        """
        newest, since = self._newest, self._other_mode_ns
        if newest is None or since is None or newest.time_ns - since < MODE_CHANGE_S * 1e9:
            return ""
        return f"the mode machine changed from {self._mode} to {newest.mode}"

    @property
    def skipped(self) -> str:
        """What was wrong with the messages since the newest reading; empty: there were none."""
        count, why = self._skipped, self._why_skipped
        return f"{count} readings rejected, the last: {why}" if count else ""

    @property
    def warning(self) -> str:
        """What the operator should know of this robot; empty: nothing."""
        return "" if self._newest is None else warning(self._newest.mode)

    def _machine_trouble(self) -> str:
        assert self._newest is not None, "asked after the first reading"
        return objection(self._newest.mode, confirmed=self.config.mode is not None)

    def _mode_trouble(self) -> str:
        found = self._newest.mode if self._newest else None
        wanted = self._mode if self.config.mode is None else self.config.mode
        if found == wanted:
            return ""
        return (
            f"the robot reports mode machine {found}, expected {wanted}; it is another robot, "
            "or in another mode: check it, then start again"
        )

    def _diagnosis(self, timeout: float) -> str:
        """Why no reading came."""
        config, traffic = self.config, self.traffic
        where = f"{config.host}:{config.state_port}"
        if traffic.garbled:
            return (
                f"{traffic.garbled} messages from {where}, none a state of a G1: "
                f"{traffic.problem}; expected LeRobot's bridge there, of lerobot 0.6"
            )
        if traffic.implausible:
            return (
                f"{traffic.implausible} states from {where}, none that a G1 can be in: "
                f"{traffic.problem}; check the robot's sensors and joints"
            )
        if reason := probe(config.host, config.state_port):
            return f"nothing at {where} ({reason}): expected LeRobot's bridge; {_START}"
        return (
            f"no state from {where} within {timeout:g} s, although something listens there; "
            f"expected LeRobot's bridge, and a robot that is switched on; {_START}"
        )

    def close(self) -> None:
        """End the thread and let go of the sockets; further calls do nothing.

        Sends nothing: the motors keep what they were told last.
        """
        if self._listener is None or self._commands.closed:
            return
        self._listener.close()
        self._commands.close()
        self._context.term()
