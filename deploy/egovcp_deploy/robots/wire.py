"""Message format of LeRobot's bridge to the Unitree G1: JSON over ZMQ, one message per frame.

    rt/lowcmd    PUSH -> port 6000    {"topic", "data": {mode_pr, mode_machine, motor_cmd: 35 x
                                       {mode, q, dq, kp, kd, tau}}}
    rt/lowstate  SUB <- port 6001     {"topic", "data": {motor_state: 35 x {q, dq, tau_est, ...},
                                       imu_state, wireless_remote, mode_machine}}

Per motor a state may also have ``temperature`` (deg C: one number, as LeRobot's bridge sends it,
or casing and winding, as the robot does), ``motorstate`` (status bits) and ``mode`` (1: enabled),
named as in Unitree's ``MotorState_``. An optional field that is absent or invalid is not reported;
the rest of the state is used.

The first 29 of the 35 motors are ``spec.JOINT_NAMES`` in order; the others are not fitted. Received
messages may be damaged or hostile: every required value is checked, and an invalid message raises
`MalformedMessage`.

``wireless_remote`` holds, in base64, the 40 bytes of the operator's remote control:

    0-1 header   2-3 buttons, a bit each   4 lx   8 rx   12 ry   16 L2   20 ly   24-39 unused

Its numbers are little-endian float32 in [-1, 1]. The order of the buttons is that of
``lerobot.teleoperators.unitree_g1``; the offsets are those of Unitree's SDK. Untested on hardware.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Never

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings
from egovcp.robot.geometry import rotation_matrix
from egovcp.robot.kinematics import TARGET_HIGH, TARGET_LOW
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp_deploy.robots.base import Array, LowState, MotorCommand

COMMAND_PORT: Final = 6000
STATE_PORT: Final = 6001
CAMERA_PORT: Final = 5555
COMMAND_TOPIC: Final = "rt/lowcmd"
STATE_TOPIC: Final = "rt/lowstate"
MOTOR_SLOTS: Final = 35
MAX_BYTES: Final = 64 * 1024  # ten times a message
SERIES: Final = 0  # mode_pr: ankles and waist are commanded as pitch and roll, not motor by motor

_ENABLED: Final = 1
_NOT_FITTED: Final = {"mode": 0, "q": 0.0, "dq": 0.0, "kp": 0.0, "kd": 0.0, "tau": 0.0}
# Far beyond any G1: joints turn by less than 3.2 rad, motors by less than 40 rad/s.
_MAX_ANGLE: Final = 10.0  # rad
_MAX_SPEED: Final = 200.0  # rad/s
_MAX_TORQUE: Final = 1000.0  # N m
_MAX_GAIN: Final = 1e4
_ROUNDING: Final = 1e-6  # rad
_QUATERNION_TOLERANCE: Final = 0.1  # an IMU that is not ready sends zeros
_MIN_DEGREES, _MAX_DEGREES = -40.0, 250.0  # range of the motors' temperature sensors, deg C

#: ``motorstate``: bit -> meaning, from Unitree's developer documentation of the G1 ("Common
#: mistakes and definitions"). Untested on hardware.
MOTOR_STATUS_BITS: Final = {
    0x1: "overcurrent",
    0x2: "transient overvoltage",
    0x4: "sustained overvoltage",
    0x8: "transient undervoltage",
    0x10: "chip overheating",
    0x20: "MOSFET too hot or too cold",
    0x40: "MOSFET temperature sensor",
    0x80: "casing too hot or too cold",
    0x100: "casing temperature sensor",
    0x200: "winding overheating",
    0x400: "rotor encoder 1",
    0x800: "rotor encoder 2",
    0x1000: "output encoder",
    0x2000: "calibration data",
    0x4000: "unexpected reset",
    0x8000: "motor locked, authentication",
    0x10000: "chip validation",
    0x20000: "calibration mode",
    0x40000: "communication checksum",
    0x80000: "driver version too low",
    0x40000000: "motor lost the connection to the robot's computer",
    0x80000000: "the robot's computer lost the connection to the motor",
}
DISCONNECTED: Final = 0x80000000

_REMOTE_BYTES: Final = 40
#: Bit 0 first. R1 and L1 are LeRobot's RB and LB, R2 and L2 its RT and LT.
BUTTONS: Final = (
    *("R1", "L1", "start", "select", "R2", "L2", "F1", "F2"),
    *("A", "B", "X", "Y", "up", "right", "down", "left"),
)
#: vx, vy (m/s) and yaw rate (rad/s) at full deflection of the sticks.
FULL_STICK: Final = (0.6, 0.2, 0.5)

_REMOTE_LAYOUT: Final = struct.Struct("<2sHfffff16x")
_REMOTE_HEADER: Final = b"\x55\x51"
_MAX_AXIS: Final = 1.05  # a worn stick may exceed 1


class MalformedMessage(Exception):
    """A message that violates its format; the text says how."""


@dataclass(frozen=True)
class LowCommand:
    """One ``rt/lowcmd`` as the robot receives it."""

    motors: MotorCommand
    velocity: Array  # (29,) rad/s, target of the damping term
    torque: Array  # (29,) N m, added to the controller's
    enabled: NDArray[np.bool_]  # (29,) motors that must follow the command
    series: bool  # whether ankles and waist are commanded as pitch and roll


def fault_text(bits: int) -> str:
    """Describe status bits, such as ``winding overheating (0x200)``."""
    names = [meaning for bit, meaning in MOTOR_STATUS_BITS.items() if bits & bit]
    if bits & ~sum(MOTOR_STATUS_BITS):
        names.append("unknown")
    return f"{', '.join(names)} (0x{bits:x})"


def encode_command(command: MotorCommand) -> bytes:
    """Encode a ``rt/lowcmd``; raises `MalformedMessage` if a value has the wrong shape or sign, or
    is out of bounds: the command must not be sent."""
    position = _checked(command.position, _MAX_ANGLE, "position")
    target = np.asarray(command.position)
    outside = (target < TARGET_LOW - _ROUNDING) | (target > TARGET_HIGH + _ROUNDING)
    if outside.any():
        i = int(outside.argmax())
        raise MalformedMessage(
            f"target of {JOINT_NAMES[i]} is {target[i]:+.2f} rad, expected {TARGET_LOW[i]:.2f} to "
            f"{TARGET_HIGH[i]:.2f}"
        )
    stiffness = _checked(command.stiffness, _MAX_GAIN, "stiffness", minimum=0.0)
    damping = _checked(command.damping, _MAX_GAIN, "damping", minimum=0.0)
    motors = [
        {"mode": _ENABLED, "q": q, "dq": 0.0, "kp": kp, "kd": kd, "tau": 0.0}
        for q, kp, kd in zip(position, stiffness, damping, strict=True)
    ]
    motors += [_NOT_FITTED] * (MOTOR_SLOTS - NUM_JOINTS)
    data = {"mode_pr": SERIES, "mode_machine": command.mode, "motor_cmd": motors}
    return json.dumps({"topic": COMMAND_TOPIC, "data": data}).encode()


def _checked(values: Array, most: float, name: str, minimum: float = -np.inf) -> list[float]:
    array = np.asarray(values, np.float64)
    if array.shape != (NUM_JOINTS,):
        raise MalformedMessage(f"{name} has shape {array.shape}, expected ({NUM_JOINTS},)")
    wrong = ~((np.abs(array) <= most) & (array >= minimum))  # true for NaN too
    if wrong.any():
        i = int(wrong.argmax())
        raise MalformedMessage(
            f"{name} of {JOINT_NAMES[i]} is {array[i]:g}, expected {max(minimum, -most):g} to "
            f"{most:g}"
        )
    numbers: list[float] = array.tolist()
    return numbers


def decode_command(payload: bytes) -> LowCommand:
    """Decode a ``rt/lowcmd``, as the robot does; raises `MalformedMessage`."""
    data = _data(payload, COMMAND_TOPIC)
    motors = _motors(data, "motor_cmd")

    def column(name: str, most: float) -> Array:
        return _numbers([motor.get(name) for motor in motors], most, name)

    return LowCommand(
        MotorCommand(
            column("q", _MAX_ANGLE),
            column("kp", _MAX_GAIN),
            column("kd", _MAX_GAIN),
            _mode(data, "mode_machine"),
        ),
        velocity=column("dq", _MAX_SPEED),
        torque=column("tau", _MAX_TORQUE),
        enabled=np.array([motor.get("mode") == _ENABLED for motor in motors]),
        series=_mode(data, "mode_pr") == SERIES,
    )


def encode_state(state: LowState, acceleration: Array) -> bytes:
    """Encode a ``rt/lowstate`` as LeRobot's bridge sends it; ``state`` has `LowState.motors`, and
    ``acceleration`` (3,) is the specific force in the IMU frame, m/s^2."""
    motors = state.motors
    assert motors is not None, "every rt/lowstate has torques"
    columns = {
        "q": state.joint_position.tolist(),
        "dq": state.joint_velocity.tolist(),
        "tau_est": motors.torque.tolist(),
    }
    if motors.temperature is not None:
        readings = motors.temperature.tolist()
        columns["temperature"] = [each[0] if len(each) == 1 else each for each in readings]
    if motors.faults is not None:
        columns["motorstate"] = motors.faults.tolist()
    if motors.enabled is not None:
        columns["mode"] = motors.enabled.astype(int).tolist()
    rows = zip(*columns.values(), strict=True)
    fitted = [dict(zip(columns, row, strict=True)) for row in rows]
    r = rotation_matrix(state.quaternion_w)
    roll, yaw = math.atan2(r[2, 1], r[2, 2]), math.atan2(r[1, 0], r[0, 0])
    pitch = math.asin(min(max(-r[2, 0], -1.0), 1.0))
    empty = {"q": 0.0, "dq": 0.0, "tau_est": 0.0, "temperature": 0.0}
    data = {
        "motor_state": fitted + [empty] * (MOTOR_SLOTS - NUM_JOINTS),
        "imu_state": {
            "quaternion": state.quaternion_w.tolist(),
            "gyroscope": state.angular_velocity.tolist(),
            "accelerometer": acceleration.tolist(),
            "rpy": [roll, pitch, yaw],
            "temperature": 35.0,
        },
        "wireless_remote": base64.b64encode(state.remote).decode("ascii"),
        "mode_machine": state.mode,
    }
    return json.dumps({"topic": STATE_TOPIC, "data": data}).encode()


def decode_state(payload: bytes, time_ns: int) -> LowState:
    """Decode a ``rt/lowstate`` that arrived at ``time_ns``; the result has `LowState.motors`.
    Raises `MalformedMessage`."""
    data = _data(payload, STATE_TOPIC)
    motors = _motors(data, "motor_state")
    imu = data.get("imu_state")
    if not isinstance(imu, dict):
        raise MalformedMessage("imu_state is missing")
    modes = _integers([motor.get("mode") for motor in motors])
    quaternion = _numbers(imu.get("quaternion"), 1.0 + _QUATERNION_TOLERANCE, "quaternion", 4)
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
        raise MalformedMessage(f"the quaternion has length {norm:.2f}, expected 1")
    return LowState(
        time_ns=time_ns,
        joint_position=_numbers([m.get("q") for m in motors], _MAX_ANGLE, "q"),
        joint_velocity=_numbers([m.get("dq") for m in motors], _MAX_SPEED, "dq"),
        quaternion_w=quaternion / norm,
        angular_velocity=_numbers(imu.get("gyroscope"), _MAX_SPEED, "gyroscope", 3),
        mode=_mode(data, "mode_machine"),
        remote=_remote(data.get("wireless_remote", "")),
        motors=MotorReadings(
            torque=_numbers([m.get("tau_est") for m in motors], _MAX_TORQUE, "tau_est"),
            temperature=_temperatures([motor.get("temperature") for motor in motors]),
            faults=_integers([motor.get("motorstate") for motor in motors]),
            enabled=None if modes is None else modes == _ENABLED,
        ),
    )


def _data(payload: bytes, topic: str) -> dict[str, Any]:
    """The content of a message on ``topic``."""
    if len(payload) > MAX_BYTES:
        raise MalformedMessage(f"{len(payload)} bytes, expected at most {MAX_BYTES}")
    try:
        message = json.loads(payload, parse_constant=_reject_constant)
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"not JSON: {str(error)[:80]}") from error
    if not isinstance(message, dict) or message.get("topic") != topic:
        raise MalformedMessage(f"not a message on {topic}")
    data = message.get("data")
    if not isinstance(data, dict):
        raise MalformedMessage("data is missing")
    return data


def _reject_constant(constant: str) -> Never:
    raise ValueError(f"{constant} is not a number")


def _motors(data: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """The motors that are fitted."""
    motors = data.get(name)
    if not isinstance(motors, list) or len(motors) != MOTOR_SLOTS:
        raise MalformedMessage(f"{name} is not a list of {MOTOR_SLOTS}")
    if not all(isinstance(motor, dict) for motor in motors):
        raise MalformedMessage(f"{name} has an entry that is not a motor")
    return motors[:NUM_JOINTS]


def _numbers(values: object, most: float, name: str, count: int = NUM_JOINTS) -> Array:
    """(count,) finite numbers within +-``most``."""
    if not isinstance(values, list) or len(values) != count:
        raise MalformedMessage(f"{name} is not {count} numbers")
    if not {float, int}.issuperset(map(type, values)):
        raise MalformedMessage(f"{name} has an entry that is not a number")
    try:
        array = np.array(values, np.float64)
    except OverflowError as error:
        raise MalformedMessage(f"{name} has a number that is too large") from error
    if not (np.abs(array) <= most).all():
        raise MalformedMessage(f"{name} is not finite or beyond {most:g}")
    return array


def _mode(data: dict[str, Any], name: str) -> int:
    mode = data.get(name)
    if type(mode) is not int or not 0 <= mode <= 255:
        raise MalformedMessage(f"{name} is not an integer from 0 to 255")
    return mode


def _remote(text: object) -> bytes:
    if not isinstance(text, str):
        raise MalformedMessage("wireless_remote is not a string")
    try:
        return base64.b64decode(text, validate=True)
    except ValueError as error:
        raise MalformedMessage("wireless_remote is not base64") from error


def _temperatures(values: Sequence[object]) -> Array | None:
    """(29, 1) or (29, 2) deg C, NaN for invalid values; None if no motor reports any: bridges
    without temperatures omit the field or fill it with zeros."""
    rows = [value if isinstance(value, list) else [value] for value in values]
    width = len(rows[0])
    if width not in (1, 2) or any(len(row) != width for row in rows):
        return None
    array = np.array([list(map(_degrees, row)) for row in rows])
    return array if np.nan_to_num(array).any() else None


def _degrees(value: object) -> float:
    if type(value) in (int, float) and _MIN_DEGREES <= value <= _MAX_DEGREES:  # type: ignore[operator]
        return float(value)  # type: ignore[arg-type]
    return math.nan


def _integers(values: Sequence[object]) -> NDArray[np.int64] | None:
    """(29,) unsigned 32-bit integers; None if any value is not one."""
    if all(type(value) is int and 0 <= value < 2**32 for value in values):
        return np.array(values, np.int64)
    return None


# --- the remote control ----------------------------------------------------------------------
@dataclass(frozen=True)
class RemoteControl:
    """Sticks and buttons of the operator's remote control; its message is ``wireless_remote``."""

    lx: float = 0.0  # left stick, 1 is right
    ly: float = 0.0  # left stick, 1 is forward
    rx: float = 0.0  # right stick, 1 is right
    ry: float = 0.0  # right stick, 1 is forward
    pressed: frozenset[str] = frozenset()  # pressed buttons, of `BUTTONS`

    @classmethod
    def parse(cls, raw: bytes) -> RemoteControl | None:
        """Decode the message; None if there is no remote control or the bytes are invalid."""
        if len(raw) != _REMOTE_BYTES:
            return None
        _, bits, lx, rx, ry, _, ly = _REMOTE_LAYOUT.unpack(raw)
        if not all(abs(axis) <= _MAX_AXIS for axis in (lx, ly, rx, ry)):  # also rejects NaN
            return None
        pressed = frozenset(name for i, name in enumerate(BUTTONS) if bits >> i & 1)
        return cls(lx, ly, rx, ry, pressed)

    def to_bytes(self) -> bytes:
        """Encode the message, in single precision."""
        bits = sum(1 << i for i, name in enumerate(BUTTONS) if name in self.pressed)
        return _REMOTE_LAYOUT.pack(_REMOTE_HEADER, bits, self.lx, self.rx, self.ry, 0.0, self.ly)

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(3,) requested vx, vy (m/s, left positive) and yaw rate (rad/s, left positive)."""
        return np.array([self.ly, -self.lx, -self.rx]) * FULL_STICK

    @classmethod
    def from_velocity(
        cls, velocity: NDArray[np.floating], pressed: frozenset[str] = frozenset()
    ) -> RemoteControl:
        """Sticks that request ``velocity`` (3,), limited to full deflection."""
        forward, left, turn = np.clip(np.asarray(velocity) / FULL_STICK, -1.0, 1.0).tolist()
        return cls(lx=-left, ly=forward, rx=-turn, pressed=pressed)
