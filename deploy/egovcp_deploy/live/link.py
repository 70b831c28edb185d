"""Messages between the control process and the planner's process: numbers and text, never code.

A message is one JSON header and the raw bytes of its arrays. Neither end waits for the other:
messages that cannot be sent at once, because the queue is full, or arrive damaged, are dropped.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import zmq

from egovcp.errors import EnvironmentFailure
from egovcp.log.tick import MotorReadings
from egovcp.plan import PolicyStep
from egovcp.spec import ACTION_DIM, DEPTH_COLS, DEPTH_ROWS, NUM_JOINTS, STATE_DIM
from egovcp_deploy.pilot.planner import BACKLOG, ObservationMessage, PlanMessage
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest

#: Field of `MotorReadings` -> type on the wire.
_MOTOR_DTYPES: Final = {
    "torque": "<f8",
    "temperature": "<f8",
    "faults": "<i8",
    "enabled": "?",
}
_PLAN_PARTS: Final = 2
MAX_RECEIVED: Final = 4 * BACKLOG  # messages per call
_DAMAGED: Final = (ValueError, LookupError, TypeError, AttributeError, OverflowError)


def encode_observation(observation: ObservationMessage) -> list[bytes]:
    """Encode one observation."""
    motors = observation.motors
    reported = [name for name in _MOTOR_DTYPES if getattr(motors, name, None) is not None]
    header = {
        "tick": observation.tick,
        "time_ns": observation.time_ns,
        "first": observation.first,
        "mode": observation.mode,
        "events": observation.events,
        "link": dict(observation.link),
        "motors": reported,
    }
    arrays = [
        np.ascontiguousarray(observation.depth, "<u2"),
        np.ascontiguousarray(observation.state, "<f4"),
        np.ascontiguousarray(observation.sent, "<f8"),
        *(np.ascontiguousarray(getattr(motors, name), _MOTOR_DTYPES[name]) for name in reported),
    ]
    return [json.dumps(header).encode(), *(array.tobytes() for array in arrays)]


def decode_observation(parts: Sequence[bytes]) -> ObservationMessage | None:
    """Inverse of `encode_observation`; None: damaged, or another message."""
    try:
        raw, depth, state, sent, *motors = parts
        header = json.loads(raw)
        reported = {
            name: np.frombuffer(part, _MOTOR_DTYPES[name]).reshape(
                (NUM_JOINTS, -1) if name == "temperature" else NUM_JOINTS
            )
            for name, part in zip(header["motors"], motors, strict=True)
        }
        return ObservationMessage(
            tick=int(header["tick"]),
            time_ns=int(header["time_ns"]),
            depth=np.frombuffer(depth, "<u2").reshape(DEPTH_ROWS, DEPTH_COLS),
            state=np.frombuffer(state, "<f4").reshape(STATE_DIM).copy(),  # torch needs to own it
            sent=np.frombuffer(sent, "<f8").reshape(ACTION_DIM),
            first=bool(header["first"]),
            mode=str(header["mode"]),
            events=tuple(map(str, header["events"])),
            motors=MotorReadings(**reported) if reported else None,
            link={str(name): float(value) for name, value in header["link"].items()},
        )
    except _DAMAGED:
        return None


def encode_plan(plan: PlanMessage) -> list[bytes]:
    """Encode the actions of a plan, without what only the log needs: the sender logs it."""
    header = {"tick": plan.tick, "plan_ms": plan.plan_ms}
    return [json.dumps(header).encode(), np.ascontiguousarray(plan.actions, "<f4").tobytes()]


def decode_plan(parts: Sequence[bytes]) -> PlanMessage | None:
    """Inverse of `encode_plan`, without events; None: damaged, or another message."""
    try:
        raw, actions = parts
        header = json.loads(raw)
        steps = np.frombuffer(actions, "<f4").reshape(1, -1, ACTION_DIM)
        step = PolicyStep(steps[:, 0], steps)
        return PlanMessage(int(header["tick"]), step, float(header["plan_ms"]))
    except _DAMAGED:
        return None


def encode_operator_command(command: OperatorCommand) -> list[bytes]:
    """Encode one input of the operator."""
    return [json.dumps(command._asdict()).encode()]


def decode_operator_command(parts: Sequence[bytes]) -> OperatorCommand | None:
    """Inverse of `encode_operator_command`; None: damaged, or another message."""
    try:
        (raw,) = parts
        header = json.loads(raw)
        velocity, request = header["velocity"], header["request"]
        if velocity is not None:
            vx, vy, yaw_rate = map(float, velocity)
            velocity = (vx, vy, yaw_rate)
        request = None if request is None else OperatorRequest(request)
        return OperatorCommand(request, velocity, header["quit"] is True)
    except _DAMAGED:
        return None


class Link:
    """One end of a pair of sockets at ``address``, such as ``ipc:///run/user/1000/egovcp``, which
    the end with ``serve`` creates; raises `EnvironmentFailure` if that is not possible."""

    def __init__(self, address: str, serve: bool) -> None:
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PAIR)
        self._socket.set_hwm(2 * BACKLOG)
        self._socket.setsockopt(zmq.LINGER, 0)
        try:
            if serve:
                self._socket.bind(address)
            else:
                self._socket.connect(address)
        except zmq.ZMQError as error:
            self._socket.close()
            raise EnvironmentFailure(
                f"cannot use the socket {address} ({error.strerror}), a path of at most 107 "
                "characters; set TMPDIR to a shorter folder that you can write to"
            ) from error

    def send(self, parts: Sequence[bytes]) -> bool:
        """Send a message, or drop it if the other end does not receive; whether it was sent."""
        try:
            self._socket.send_multipart(parts, zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def receive(self, timeout_s: float = 0.0) -> Iterator[list[bytes]]:
        """All waiting messages, at most `MAX_RECEIVED`, so that a sender cannot delay the
        receiver for longer; waits at most ``timeout_s`` for the first."""
        if timeout_s > 0 and not self._socket.poll(round(timeout_s * 1e3)):
            return
        for _ in range(MAX_RECEIVED):
            try:
                yield self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return

    def close(self) -> None:
        """Close this end."""
        self._socket.close()


class RemotePlanner:
    """A `PlannerClient` whose planner runs in another process."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._commands: list[OperatorCommand] = []
        self.alive = True  # set to false by the owner once the planner's process has ended

    def submit(self, observation: ObservationMessage) -> bool:
        """Send o_t; it is dropped if the planner does not receive."""
        return self._link.send(encode_observation(observation))

    def poll(self, now_ns: int) -> list[PlanMessage]:
        """Plans that have arrived; operator commands are kept for `take_commands`."""
        plans = []
        for parts in self._link.receive():
            if len(parts) == _PLAN_PARTS and (plan := decode_plan(parts)) is not None:
                plans.append(plan)
            elif (command := decode_operator_command(parts)) is not None:
                self._commands.append(command)
        return plans

    def take_commands(self) -> list[OperatorCommand]:
        """Operator commands since the last call, oldest first."""
        commands, self._commands = self._commands, []
        return commands
