"""Between the control process and the planner process: messages of numbers, never code.

A message is one JSON header and the raw bytes of its arrays. Neither end ever waits for the
other: what cannot be sent at once is dropped, and what arrives damaged is dropped too.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
import zmq
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings
from egovcp.plan import PolicyStep
from egovcp.spec import ACTION_DIM, DEPTH_COLS, DEPTH_ROWS, NUM_JOINTS, STATE_DIM
from egovcp_deploy.pilot.desk import BACKLOG, Reply, Report
from egovcp_deploy.pilot.states import Request

_REPLY_PARTS: Final = 2
_MOST_RECEIVED: Final = 4 * BACKLOG  # messages per call


@dataclass(frozen=True)
class Order:
    """What the operator wants, sent from the planner's process, where the keyboard is."""

    request: Request | None = None
    velocity: tuple[float, float, float] | None = None
    quit: bool = False
    """End the control process; it damps the motors first."""


def encode_report(report: Report) -> list[bytes]:
    """One observation."""
    header = {
        "tick": report.tick,
        "time_ns": report.time_ns,
        "first": report.first,
        "mode": report.mode,
        "events": report.events,
        "link": dict(report.link),
        "motors": None,
    }
    motors: NDArray[np.float64] = np.zeros(0)
    if report.motors is not None:
        header["motors"], motors = _pack_motors(report.motors)
    arrays = (
        np.ascontiguousarray(report.depth, "<u2"),
        np.ascontiguousarray(report.state, "<f4"),
        np.ascontiguousarray(report.sent, "<f8"),
        np.ascontiguousarray(motors, "<f8"),
    )
    return [json.dumps(header).encode(), *(array.tobytes() for array in arrays)]


def decode_report(parts: Sequence[bytes]) -> Report | None:
    """The inverse; None for anything else."""
    try:
        raw, depth, state, sent, motors = parts
        header = json.loads(raw)
        return Report(
            tick=int(header["tick"]),
            time_ns=int(header["time_ns"]),
            depth=np.frombuffer(depth, "<u2").reshape(DEPTH_ROWS, DEPTH_COLS),
            state=np.frombuffer(state, "<f4").reshape(STATE_DIM).copy(),  # torch wants to own it
            sent=np.frombuffer(sent, "<f8").reshape(ACTION_DIM),
            first=bool(header["first"]),
            mode=str(header["mode"]),
            events=tuple(map(str, header["events"])),
            motors=_unpack_motors(header["motors"], np.frombuffer(motors, "<f8")),
            link={str(name): float(value) for name, value in header["link"].items()},
        )
    except (ValueError, LookupError, TypeError, AttributeError):
        return None


def _pack_motors(motors: MotorReadings) -> tuple[dict[str, int], NDArray[np.float64]]:
    """Field -> number of its rows, and all rows (n, 29) in that order."""
    values = {f.name: getattr(motors, f.name) for f in fields(motors)}
    blocks = {
        k: np.asarray(v, np.float64).T.reshape(-1, NUM_JOINTS)
        for k, v in values.items()
        if v is not None
    }
    return {name: len(block) for name, block in blocks.items()}, np.concatenate([*blocks.values()])


def _unpack_motors(
    rows: Mapping[str, int] | None, values: NDArray[np.float64]
) -> MotorReadings | None:
    """The inverse."""
    if rows is None:
        return None
    ends = np.cumsum(list(rows.values()))
    blocks = dict(zip(rows, np.split(values.reshape(-1, NUM_JOINTS), ends[:-1]), strict=True))
    whole = {
        name: blocks[name][0].astype(np.int64) for name in ("faults", "lost") if name in blocks
    }
    return MotorReadings(
        torque=blocks["torque"][0],
        temperature=blocks["temperature"].T if "temperature" in blocks else None,
        faults=whole.get("faults"),
        lost=whole.get("lost"),
        enabled=blocks["enabled"][0] != 0.0 if "enabled" in blocks else None,
    )


def encode_reply(reply: Reply) -> list[bytes]:
    """A plan: what the control process needs of a reply."""
    plan = reply.step.plan if reply.step.plan.size else reply.step.action[:, None]
    header = {"tick": reply.tick, "plan_ms": reply.plan_ms, "events": reply.events}
    return [json.dumps(header).encode(), np.ascontiguousarray(plan[0], "<f4").tobytes()]


def decode_reply(parts: Sequence[bytes]) -> Reply | None:
    """The inverse; None for anything else."""
    try:
        raw, plan = parts
        header = json.loads(raw)
        steps = np.frombuffer(plan, "<f4").reshape(1, -1, ACTION_DIM)
        step = PolicyStep(steps[:, 0], steps)
        events = tuple(map(str, header["events"]))
        return Reply(int(header["tick"]), step, float(header["plan_ms"]), events=events)
    except (ValueError, KeyError, TypeError, IndexError):
        return None


def encode_order(order: Order) -> list[bytes]:
    """An order of the operator."""
    header = {"request": order.request, "velocity": order.velocity, "quit": order.quit}
    return [json.dumps(header).encode()]


def decode_order(parts: Sequence[bytes]) -> Order | None:
    """The inverse; None for anything else."""
    try:
        (raw,) = parts
        return _order(json.loads(raw))
    except (ValueError, KeyError, TypeError):
        return None


def _order(header: Mapping[str, Any]) -> Order:
    velocity, request = header["velocity"], header["request"]
    if velocity is not None:
        vx, vy, yaw = map(float, velocity)
        velocity = (vx, vy, yaw)
    return Order(None if request is None else Request(request), velocity, header["quit"] is True)


class Link:
    """One end of a pair of sockets.

    Args:
        address: such as ``ipc:///run/user/1000/egovcp``; only processes of this machine.
        serve: whether this end creates the address.
    """

    def __init__(self, address: str, serve: bool) -> None:
        self._socket: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.PAIR)
        self._socket.set_hwm(2 * BACKLOG)
        self._socket.setsockopt(zmq.LINGER, 0)
        if serve:
            self._socket.bind(address)
        else:
            self._socket.connect(address)
        self.dropped = 0
        """Messages that could not be sent at once."""

    def send(self, parts: Sequence[bytes]) -> bool:
        """Send, or drop if the other end does not take it."""
        try:
            self._socket.send_multipart(parts, zmq.NOBLOCK)
        except zmq.Again:
            self.dropped += 1
            return False
        return True

    def receive(self, timeout_s: float = 0.0) -> Iterator[list[bytes]]:
        """Everything that is there, up to `_MOST_RECEIVED`, so that a sender cannot delay the
        receiver for longer; waits for the first at most ``timeout_s``."""
        if timeout_s > 0 and not self._socket.poll(round(timeout_s * 1e3)):
            return
        for _ in range(_MOST_RECEIVED):
            try:
                yield self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return

    def close(self) -> None:
        """Close this end."""
        self._socket.close()


class RemoteDesk:
    """The planner in another process, seen from the control process.

    Args:
        link: to the planner.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self.orders: list[Order] = []
        """What the operator has ordered since this was last emptied, oldest first."""
        self.alive = True
        """Set to false by whoever learns that the planner's process has ended."""

    def submit(self, report: Report) -> None:
        """Send o_t; a planner that does not listen loses it."""
        self._link.send(encode_report(report))

    def poll(self, now_ns: int) -> list[Reply]:
        """Plans that have arrived; orders are put aside."""
        replies = []
        for parts in self._link.receive():
            if len(parts) == _REPLY_PARTS and (reply := decode_reply(parts)) is not None:
                replies.append(reply)
            elif (order := decode_order(parts)) is not None:
                self.orders.append(order)
        return replies
