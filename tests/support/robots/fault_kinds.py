"""The faults that live runs are tested with, and the required reactions."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np

from egovcp.plan import PolicyStep
from egovcp.spec import ACTION_DIM
from egovcp_deploy.live.link import encode_plan
from egovcp_deploy.pilot.planner import ObservationMessage, PlanMessage
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest
from egovcp_deploy.robots.wire import DISCONNECTED

from . import fault_messages as m
from .fault_messages import Alteration, Edit
from .fault_rig import FaultRig, Planner, constant_plan, constant_reply
from .stream_proxy import StreamFault

Begin = Callable[[FaultRig], None]


class Reaction(StrEnum):
    """Required reaction to a fault."""

    RUN = "run"
    """Never damped, never held for missing proprioception, and in RUN afterwards."""
    HOLD = "hold"
    """Held, not damped, and in RUN afterwards."""
    DAMP = "damp"
    """Damped within the time limit after the last valid reading."""
    LATER = "later"
    """Damped at any time: once the robot tilts, or once no more valid states arrive."""
    ANY = "any"
    """Any reaction; only the commands are checked."""


@dataclass(frozen=True)
class FaultKind:
    """One fault.

    Args:
        name: unique.
        reaction: required.
        begin: starts it; called in the robot's thread, between two steps.
        duration_s: how long it lasts, unless the robot is damped before.
        since_onset: whether times count from the onset, for faults that do not affect the states;
            else from the last valid state.
        reason: required part of the reason reported for HOLD or DAMP; empty: any.
    """

    name: str
    reaction: Reaction
    begin: Begin
    duration_s: float = 0.5
    since_onset: bool = False
    reason: str = ""


def _fault(name: str, value: object = True) -> Begin:
    """Set one of `InjectedFaults`."""
    return lambda rig: setattr(rig.fake.faults, name, value)


def _states(alteration: Alteration) -> Begin:
    return lambda rig: setattr(rig.fake, "alter_state", alteration)


def _stateful(make: Callable[[], Alteration]) -> Begin:
    """As `_states`, with an alteration that has a state and is made when the fault begins."""
    return lambda rig: setattr(rig.fake, "alter_state", make())


def _edited(edit: Edit) -> Begin:
    """Edit every state."""
    return _states(m.edited(edit))


def _edited_once(edit: Edit) -> Begin:
    """Edit the first state."""
    return _stateful(lambda: m.once(m.edited(edit)))


def _edited_at_50_hz(edit: Edit) -> Begin:
    """Edit every fourth state."""
    return _stateful(lambda: m.every(4, m.edited(edit)))


def _replaced(*messages: bytes) -> Begin:
    return _states(lambda message: messages)


def _generated(messages: Callable[[], Iterable[bytes]]) -> Begin:
    return _states(lambda message: messages())


def _knee(name: str, value: object) -> Begin:
    """The motor of the left knee reports ``value`` in the field ``name``."""
    return _edited(m.motor(m.KNEE, name, lambda usual: value))


def _dropped(status: int, mode: int) -> Begin:
    """The left knee gives no torque, and reports this status and mode."""
    motorstate = m.edited(m.motor(m.KNEE, "motorstate", lambda v: status))
    enabled = m.edited(m.motor(m.KNEE, "mode", lambda v: mode))

    def begin(rig: FaultRig) -> None:
        rig.fake.faults.dropped_motor = m.KNEE
        rig.fake.alter_state = lambda message: enabled(*motorstate(message))

    return begin


def _number(number: str) -> Begin:
    return _states(m.raw_position(number))


_FULL_RATE: Final = 100  # messages per state, 20 000 a second


def _stream(fault: StreamFault, alteration: Alteration | None = None) -> Begin:
    def begin(rig: FaultRig) -> None:
        rig.proxy.fault = fault
        if alteration is not None:
            rig.fake.alter_state = alteration

    return begin


_R, _H, _D, _ANY = Reaction.RUN, Reaction.HOLD, Reaction.DAMP, Reaction.ANY

_STATES: Final = (
    FaultKind("state: silent", _D, _fault("stop_state")),
    FaultKind("state: silent for 60 ms", _R, _stateful(lambda: m.for_seconds(0.06, m.nothing))),
    FaultKind("state: silent for 150 ms", _H, _stateful(lambda: m.for_seconds(0.15, m.nothing))),
    FaultKind("state: frozen", _D, _fault("freeze_state")),
    FaultKind("state: every second torn", _R, _fault("truncate_state")),
    FaultKind("state: all torn", _D, _states(lambda message: (message[: len(message) // 2],))),
    FaultKind("state: 30 % lost", _R, _fault("drop", 0.3)),
    FaultKind("state: empty messages", _D, _replaced(b"")),
    FaultKind("state: not JSON", _D, _replaced(b"\xff\xfe not json")),
    FaultKind("state: another topic", _D, _replaced(b'{"topic": "rt/other", "data": {}}')),
    FaultKind("state: a JSON list", _D, _replaced(b"[1, 2, 3]")),
    FaultKind("state: nested 30000 deep", _D, _replaced(b"[" * 30000)),
    FaultKind("state: position NaN", _D, _number("NaN")),
    FaultKind("state: position Infinity", _D, _number("-Infinity")),
    FaultKind("state: position 1e400", _D, _number("1e400")),
    FaultKind("state: position with 4000 digits", _D, _number("9" * 4000)),
    FaultKind("state: position null", _D, _number("null")),
    FaultKind("state: position a string", _D, _number('"0.3"')),
    FaultKind("state: position true", _D, _number("true")),
    FaultKind("state: no motors", _D, _edited(m.without_field("motor_state"))),
    FaultKind(
        "state: 29 motor slots",
        _D,
        _edited(lambda d: d.__setitem__("motor_state", d["motor_state"][:29])),
    ),
    FaultKind("state: no IMU", _D, _edited(m.without_field("imu_state"))),
    FaultKind("state: no mode machine", _D, _edited(m.without_field("mode_machine"))),
    FaultKind("state: remote control not base64", _D, _edited(m.set_field("wireless_remote", "%"))),
    FaultKind("state: quaternion zero", _D, _edited(m.imu("quaternion", lambda q: [0.0] * 4))),
    FaultKind(
        "state: quaternion of length 2",
        _D,
        _edited(m.imu("quaternion", lambda q: [2 * v for v in q])),
    ),
)
_GYRO: Final = m.gyroscope(150.0)
_SPEED: Final = m.motor(m.KNEE, "dq", lambda v: 190.0)
_JUMP: Final = m.motor(m.KNEE, "q", lambda q: q + 0.5)
_IMPLAUSIBLE: Final = (
    FaultKind("gyroscope: 150 rad/s", _D, _edited(_GYRO)),
    FaultKind("gyroscope: 150 rad/s once", _R, _edited_once(_GYRO)),
    FaultKind("gyroscope: 150 rad/s at 50 Hz", _R, _edited_at_50_hz(_GYRO)),
    FaultKind("gyroscope: 20 rad/s", _D, _edited(m.gyroscope(20.0))),
    FaultKind("joint speed: 190 rad/s", _D, _edited(_SPEED)),
    FaultKind("joint speed: 190 rad/s once", _R, _edited_once(_SPEED)),
    FaultKind("joint speed: 190 rad/s at 50 Hz", _R, _edited_at_50_hz(_SPEED)),
    FaultKind("joint speed: 25 rad/s", _D, _knee("dq", 25.0)),
    FaultKind(
        "joint speed: all +-190 rad/s",
        _D,
        _edited(m.all_motors("dq", lambda i, v: 190.0 * (-1) ** i)),
    ),
    FaultKind("joint position: 9 rad", _D, _knee("q", 9.0)),
    FaultKind("joint position: jumps by 0.5 rad", _D, _edited(_JUMP)),
    FaultKind("joint position: jumps by 0.5 rad once", _R, _edited_once(_JUMP)),
    FaultKind("joint position: all zero", _D, _edited(m.all_motors("q", lambda i, q: 0.0))),
    FaultKind("joints: random within bounds", _D, _edited(m.random_joints)),
    FaultKind("torque: 900 N m", _D, _knee("tau_est", 900.0)),
    FaultKind(
        "torque: 900 N m once", _R, _edited_once(m.motor(m.KNEE, "tau_est", lambda t: 900.0))
    ),
    FaultKind("orientation: jumps by 0.8 rad", _D, _edited(m.imu("quaternion", m.rolled))),
    FaultKind(
        "orientation: jumps by 0.8 rad once", _R, _edited_once(m.imu("quaternion", m.rolled))
    ),
    FaultKind("mode machine: 5 to 6", _D, _fault("mode", 6)),
    FaultKind("mode machine: 5 to 4", _D, _fault("mode", 4)),
    FaultKind("mode machine: 0 once", _R, _edited_once(m.set_field("mode_machine", 0))),
)
_OVERHEATED: Final = 0x200  # status bits, see `wire.MOTOR_STATUS_BITS`


def _motor(
    name: str, reaction: Reaction, begin: Begin, reason: str = "", duration_s: float = 0.5
) -> FaultKind:
    return FaultKind(f"motor: {name}", reaction, begin, duration_s, reason=reason)


_MOTORS: Final = (
    _motor("winding at 125 deg C", _H, _fault("hot_motor", (m.KNEE, 125.0)), "is too hot", 1.0),
    _motor(
        "one temperature, 85 deg C",
        _H,
        _edited(m.all_motors("temperature", lambda i, v: 85 if i == m.KNEE else 35)),
        "is too hot",
        1.0,
    ),
    _motor("status overheated", _H, _knee("motorstate", _OVERHEATED), "winding overheating", 1.0),
    _motor("no temperatures", _R, _edited(m.without_motor_fields("temperature"))),
    _motor("temperature 900 deg C", _R, _knee("temperature", [900, 900])),
    _motor(
        "no status, mode and temperature",
        _R,
        _edited(m.without_motor_fields("motorstate", "mode", "temperature")),
    ),
    _motor("dropped, status disconnected", _D, _dropped(DISCONNECTED, 1), "lost the connection"),
    _motor("dropped, mode off", _D, _dropped(0, 0), "its mode is off"),
    _motor(
        "dropped without a report", Reaction.LATER, _dropped(0, 1), "does not follow its target"
    ),
)
_FLOODS: Final = (
    FaultKind(
        "flood: 2 kB garbage, 40 per 10 ms", _R, _states(m.followed_by(lambda: m.garbage(20)))
    ),
    FaultKind("flood: the same without states", _D, _generated(lambda: m.garbage(20))),
    FaultKind(
        "flood: garbage at full rate", _ANY, _states(m.followed_by(lambda: m.garbage(_FULL_RATE)))
    ),
    FaultKind(
        "flood: the same without states, full rate", _D, _generated(lambda: m.garbage(_FULL_RATE))
    ),
    FaultKind("flood: 30 kB of valid JSON without states", _D, _generated(lambda: m.valid_json(5))),
    FaultKind("flood: one state repeated", _D, _stateful(lambda: m.repeats())),
    FaultKind(
        "flood: oversized messages",
        Reaction.LATER,
        _states(m.followed_by(lambda: [b"x" * 200_000])),
    ),
    FaultKind("flood: oversized without states", _D, _replaced(*[b"x" * 200_000] * 4)),
    FaultKind(
        "flood: garbage in split packets",
        _D,
        _stream(StreamFault.SPLIT, lambda message: m.garbage(4)),
    ),
    FaultKind("connection: split packets", _R, _stream(StreamFault.SPLIT)),
    FaultKind("connection: 20 kB/s", _D, _stream(StreamFault.SLOW)),
    FaultKind("connection: stalls", _D, _stream(StreamFault.STALL)),
    FaultKind("connection: cut, port closed", _D, _stream(StreamFault.CUT)),
)


def _images(alteration: Alteration) -> Begin:
    return lambda rig: setattr(rig.fake, "alter_image", alteration)


def _image(name: str, reaction: Reaction, begin: Begin) -> FaultKind:
    return FaultKind(f"image: {name}", reaction, begin, since_onset=True)


_IMAGES: Final = (
    _image("silent", _H, _fault("stop_camera")),
    _image("frozen", _H, _fault("freeze_camera")),
    _image("cut short", _H, _images(lambda message: (message[:-100],))),
    _image("wrong checksum", _H, _images(m.bad_checksum)),
    _image("another field of view", _H, _images(m.wrong_field_of_view)),
    _image("garbage", _H, _images(lambda message: m.garbage(1))),
    _image("flood of garbage", _R, _images(m.followed_by(lambda: m.garbage(20)))),
    _image("oversized", _H, _images(lambda message: (message * 20,))),
)


def _planner(planner: Planner) -> Begin:
    return lambda rig: setattr(rig, "planner", planner)


def _stateful_planner(make: Callable[[], Planner]) -> Begin:
    """As `_planner`, with a planner that has a state and is made when the fault begins."""
    return lambda rig: setattr(rig, "planner", make())


def _plan_of(value: float) -> Planner:
    return lambda report: [encode_plan(_filled(report, np.full((1, 4, ACTION_DIM), value)))]


def _filled(
    report: ObservationMessage, plan: np.ndarray[Any, np.dtype[np.floating[Any]]]
) -> PlanMessage:
    values = plan.astype(np.float32)
    return PlanMessage(report.tick, PolicyStep(values[:, 0], values, iterations=1), 1.0)


def _shaking() -> Planner:
    rng = np.random.default_rng(0)
    return lambda report: [
        encode_plan(_filled(report, rng.choice([-1.0, 1.0], (1, 4, ACTION_DIM))))
    ]


def _late(ticks: int) -> Planner:
    waiting: list[list[bytes]] = []

    def answer(report: ObservationMessage) -> list[list[bytes]]:
        waiting.append(encode_plan(constant_reply(report)))
        return [waiting.pop(0)] if len(waiting) > ticks else []

    return answer


def _shifted(report: ObservationMessage) -> list[list[bytes]]:
    return [encode_plan(PlanMessage(report.tick + 1000, constant_reply(report).step, 1.0))]


def _order(order: OperatorCommand) -> Begin:
    return lambda rig: rig.order(order)


def _flood_of_messages(rig: FaultRig) -> None:
    rig.planner = lambda report: [*([g] for g in m.garbage(100)), *constant_plan(report)]


def _pressed(*buttons: str) -> Begin:
    return lambda rig: setattr(rig.fake, "pressed", frozenset(buttons))


def _other(name: str, reaction: Reaction, begin: Begin, duration_s: float = 0.5) -> FaultKind:
    return FaultKind(name, reaction, begin, duration_s, since_onset=True)


_OTHERS: Final = (
    _other("planner: silent", _H, _planner(lambda report: [])),
    _other("planner: 200 ms late", _H, _stateful_planner(lambda: _late(5))),
    _other("planner: plans NaN", _H, _planner(_plan_of(np.nan)), 0.6),
    _other("planner: plans Infinity", _H, _planner(_plan_of(np.inf)), 0.6),
    _other("planner: plans 1e30", _R, _planner(_plan_of(1e30))),
    _other("planner: random full strokes", _R, _planner(_shaking())),
    _other("planner: answers garbage", _H, _planner(lambda report: [m.garbage(1), [b"", b""]])),
    _other("planner: answers of other ticks", _H, _planner(_shifted)),
    _other("planner: flood of messages", _ANY, _flood_of_messages),
    _other("operator: velocity NaN", _R, _order(OperatorCommand(velocity=(np.nan,) * 3))),
    _other("operator: velocity 1e9", _R, _order(OperatorCommand(velocity=(1e9,) * 3))),
    _other("operator: emergency stop", _D, _order(OperatorCommand(OperatorRequest.ESTOP))),
    _other("remote control: emergency stop", _D, _pressed("L1", "B")),
    _other(
        "remote control: sticks NaN",
        _R,
        _edited(m.set_field("wireless_remote", "VVEAAP" + "/" * 46)),
    ),
    _other("robot: pushed", _R, _fault("push", (0.2, 0.0))),
    _other("robot: pushed over", Reaction.LATER, _fault("push", (-2.5, 1.0)), 3.0),
    _other("robot: ignores commands", Reaction.LATER, _fault("ignore_commands"), 4.0),
    _other("robot: another program sends commands", _ANY, _fault("other_publisher")),
)


def _signal(number: signal.Signals) -> Begin:
    def begin(rig: FaultRig) -> None:
        assert rig.process.pid is not None
        os.kill(rig.process.pid, number)

    return begin


_PROCESSES: Final = (
    _other("control process: SIGKILL", _D, _signal(signal.SIGKILL)),
    _other("control process: SIGTERM", _D, _signal(signal.SIGTERM)),
)

FAULTS: Final = (*_STATES, *_IMPLAUSIBLE, *_MOTORS, *_FLOODS, *_IMAGES, *_OTHERS, *_PROCESSES)
"""All faults; names are unique."""
