"""The G1 behind LeRobot's bridge: a `Body` whose motors are at the other end of a wire.

A thread of its own receives, checks and time-stamps every reading; `BridgeBody.read` only looks
at the newest. Commands go out at once or not at all: none waits for a robot to come back.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

import zmq

from egovcp.bounds import bounded, check_bounds
from egovcp.errors import EnvironmentFailure
from egovcp_deploy.robots.body import BodyState, MotorCommand
from egovcp_deploy.robots.listener import Listener, join, probe
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
    """Mode machine that the robot must report, which tells its hardware; null: any, as long as it
    stays the same."""

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass
class Traffic:
    """What has passed over the wire."""

    readings: int = 0
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
        self._newest: BodyState | None = None
        self._payload = b""
        self._mode: int | None = None
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
            if trouble := self._mode_trouble():
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

    def _take(self, payload: bytes, time_ns: int) -> None:
        """A message that arrived at ``time_ns``."""
        if payload == self._payload:
            self.traffic.repeated += 1
            return
        self._payload = payload
        try:
            state = decode_state(payload, time_ns)
        except Garbled as error:
            self.traffic.garbled += 1
            self.traffic.problem = str(error)
            return
        self.traffic.readings += 1
        self.watch.heard(state)
        if self._mode is None:
            self._mode = state.body.mode
        self._newest = state.body

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
