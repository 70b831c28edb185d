"""LeRobot's bridge to the Unitree G1, byte by byte: JSON over ZMQ, one message per frame.

    rt/lowcmd    PUSH -> port 6000    {"topic", "data": {mode_pr, mode_machine, motor_cmd: 35 x
                                       {mode, q, dq, kp, kd, tau}}}
    rt/lowstate  SUB <- port 6001     {"topic", "data": {motor_state: 35 x {q, dq, tau_est, ...},
                                       imu_state, wireless_remote, mode_machine}}

Per motor a state may also carry ``temperature`` (deg C: one number, as LeRobot's bridge sends it,
or casing and winding, as the robot does), ``motorstate`` (status bits), ``lost`` (packets) and
``mode`` (1: obeys). Names and meanings are those of Unitree's ``MotorState_``.

The first 29 of the 35 motors are ``spec.JOINT_NAMES`` in order; the others are not fitted. What
arrives may be torn or hostile: everything is checked, and what is wrong is `Garbled`.
"""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from typing import Any, Final, Never

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings
from egovcp.robot.kinematics import TARGET_HIGH, TARGET_LOW
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp_deploy.robots.body import BodyState, MotorCommand
from egovcp_deploy.robots.motor_fields import decode_motor_fields, encode_motor_fields

Array = NDArray[np.float64]

COMMAND_PORT: Final = 6000
STATE_PORT: Final = 6001
CAMERA_PORT: Final = 5555
COMMAND_TOPIC: Final = "rt/lowcmd"
STATE_TOPIC: Final = "rt/lowstate"
MOTOR_SLOTS: Final = 35
MOST_BYTES: Final = 64 * 1024  # ten times a message
SERIES: Final = 0  # mode_pr: ankles and waist are commanded as pitch and roll, not motor by motor

_ENABLED: Final = 1
_NOT_FITTED: Final = {"mode": 0, "q": 0.0, "dq": 0.0, "kp": 0.0, "kd": 0.0, "tau": 0.0}
# Beyond these no G1 can be: joints turn by less than 3.2 rad, motors by less than 40 rad/s.
_MOST_ANGLE: Final = 10.0  # rad
_MOST_SPEED: Final = 200.0  # rad/s
_MOST_TORQUE: Final = 1000.0  # N m
_MOST_GAIN: Final = 1e4
_ROUNDING: Final = 1e-6  # rad
_QUATERNION_SLACK: Final = 0.1  # an IMU that is not ready sends zeros


class Garbled(Exception):
    """A message is not what it should be; the text says how."""


@dataclass(frozen=True)
class LowState:
    """All that we use of one ``rt/lowstate``."""

    body: BodyState
    sources: int | None = None
    """Programs whose commands reached the robot in the last half second; None: not told. Our own
    addition, ``command_sources``: LeRobot's bridge does not know."""

    @property
    def motors(self) -> MotorReadings:
        """Torque, temperature and status of the motors."""
        assert self.body.motors is not None, "every rt/lowstate has them"
        return self.body.motors


@dataclass(frozen=True)
class LowCommand:
    """One ``rt/lowcmd`` as the robot takes it."""

    motors: MotorCommand
    velocity: Array
    """(29,) rad/s that the damping works against."""
    torque: Array
    """(29,) N m on top."""
    enabled: NDArray[np.bool_]
    """(29,) motors that are to obey at all."""
    series: bool
    """Whether ankles and waist are meant as pitch and roll."""


def encode_command(command: MotorCommand) -> bytes:
    """``rt/lowcmd``.

    Raises:
        Garbled: the command is not numbers of the right shape and sign, or beyond all bounds; it
            must not be sent.
    """
    position = _checked(command.position, _MOST_ANGLE, "position")
    target = np.asarray(command.position)
    beyond = (target < TARGET_LOW - _ROUNDING) | (target > TARGET_HIGH + _ROUNDING)
    if beyond.any():
        i = int(beyond.argmax())
        raise Garbled(
            f"target of {JOINT_NAMES[i]} is {target[i]:+.2f} rad, expected {TARGET_LOW[i]:.2f} to "
            f"{TARGET_HIGH[i]:.2f}"
        )
    stiffness = _checked(command.stiffness, _MOST_GAIN, "stiffness", least=0.0)
    damping = _checked(command.damping, _MOST_GAIN, "damping", least=0.0)
    motors = [
        {"mode": _ENABLED, "q": q, "dq": 0.0, "kp": kp, "kd": kd, "tau": 0.0}
        for q, kp, kd in zip(position, stiffness, damping, strict=True)
    ]
    motors += [_NOT_FITTED] * (MOTOR_SLOTS - NUM_JOINTS)
    data = {"mode_pr": SERIES, "mode_machine": command.mode, "motor_cmd": motors}
    return json.dumps({"topic": COMMAND_TOPIC, "data": data}).encode()


def _checked(values: Array, most: float, name: str, least: float = -np.inf) -> list[float]:
    array = np.asarray(values, np.float64)
    if array.shape != (NUM_JOINTS,) or not ((np.abs(array) <= most) & (array >= least)).all():
        raise Garbled(f"{name} of a command is not {NUM_JOINTS} possible numbers")
    numbers: list[float] = array.tolist()
    return numbers


def decode_command(payload: bytes) -> LowCommand:
    """The inverse of `encode_command`, for whoever plays the robot.

    Raises:
        Garbled: it is none.
    """
    data = _data(payload, COMMAND_TOPIC)
    motors = _motors(data, "motor_cmd")
    column = {
        name: _numbers([motor.get(name) for motor in motors], most, name)
        for name, most in (
            ("q", _MOST_ANGLE),
            ("dq", _MOST_SPEED),
            ("kp", _MOST_GAIN),
            ("kd", _MOST_GAIN),
            ("tau", _MOST_TORQUE),
        )
    }
    modes = [motor.get("mode") for motor in motors]
    return LowCommand(
        MotorCommand(column["q"], column["kp"], column["kd"], _mode(data, "mode_machine")),
        velocity=column["dq"],
        torque=column["tau"],
        enabled=np.array([mode == _ENABLED for mode in modes]),
        series=_mode(data, "mode_pr") == SERIES,
    )


def encode_state(state: LowState, acceleration: Array) -> bytes:
    """``rt/lowstate`` as LeRobot's bridge sends it.

    Args:
        state: the reading; ``command_sources`` is left out where it is None.
        acceleration: (3,) specific force in the IMU frame, m/s^2.
    """
    body = state.body
    columns = {
        "q": body.joint_position.tolist(),
        "dq": body.joint_velocity.tolist(),
        "tau_est": state.motors.torque.tolist(),
        **encode_motor_fields(state.motors),
    }
    rows = zip(*columns.values(), strict=True)
    motors = [dict(zip(columns, row, strict=True)) for row in rows]
    empty = {"q": 0.0, "dq": 0.0, "tau_est": 0.0, "temperature": 0.0}
    data = {
        "motor_state": motors + [empty] * (MOTOR_SLOTS - NUM_JOINTS),
        "imu_state": {
            "quaternion": body.quaternion_w.tolist(),
            "gyroscope": body.angular_velocity.tolist(),
            "accelerometer": acceleration.tolist(),
            "rpy": _roll_pitch_yaw(body.quaternion_w),
            "temperature": 35.0,
        },
        "wireless_remote": base64.b64encode(body.remote).decode("ascii"),
        "mode_machine": body.mode,
    }
    if state.sources is not None:
        data["command_sources"] = state.sources
    return json.dumps({"topic": STATE_TOPIC, "data": data}).encode()


def decode_state(payload: bytes, time_ns: int) -> LowState:
    """The reading in a ``rt/lowstate`` that arrived at ``time_ns``.

    Raises:
        Garbled: it is none, or says what no robot can measure.
    """
    data = _data(payload, STATE_TOPIC)
    motors = _motors(data, "motor_state")
    imu = data.get("imu_state")
    if not isinstance(imu, dict):
        raise Garbled("imu_state is missing")
    quaternion = _numbers(imu.get("quaternion"), 1.0 + _QUATERNION_SLACK, "quaternion", 4)
    norm = float(np.linalg.norm(quaternion))
    if abs(norm - 1.0) > _QUATERNION_SLACK:
        raise Garbled(f"the quaternion has length {norm:.2f}, expected 1")
    sources = data.get("command_sources")
    body = BodyState(
        time_ns=time_ns,
        joint_position=_numbers([m.get("q") for m in motors], _MOST_ANGLE, "q"),
        joint_velocity=_numbers([m.get("dq") for m in motors], _MOST_SPEED, "dq"),
        quaternion_w=quaternion / norm,
        angular_velocity=_numbers(imu.get("gyroscope"), _MOST_SPEED, "gyroscope", 3),
        mode=_mode(data, "mode_machine"),
        remote=_remote(data.get("wireless_remote", "")),
        motors=MotorReadings(
            _numbers([m.get("tau_est") for m in motors], _MOST_TORQUE, "tau_est"),
            **decode_motor_fields(motors),
        ),
    )
    return LowState(body, None if sources is None else _mode(data, "command_sources"))


def _data(payload: bytes, topic: str) -> dict[str, Any]:
    """The content of a message on ``topic``."""
    if len(payload) > MOST_BYTES:
        raise Garbled(f"{len(payload)} bytes, expected at most {MOST_BYTES}")
    try:
        message = json.loads(payload, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise Garbled(f"not JSON: {str(error)[:80]}") from error
    if not isinstance(message, dict) or message.get("topic") != topic:
        raise Garbled(f"no message on {topic}")
    data = message.get("data")
    if not isinstance(data, dict):
        raise Garbled("no data")
    return data


def _refuse(constant: str) -> Never:
    raise ValueError(f"{constant} is no number")


def _motors(data: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """The motors that are fitted."""
    motors = data.get(name)
    if not isinstance(motors, list) or len(motors) != MOTOR_SLOTS:
        raise Garbled(f"{name} is no list of {MOTOR_SLOTS}")
    if not all(isinstance(motor, dict) for motor in motors):
        raise Garbled(f"{name} holds something else than motors")
    return motors[:NUM_JOINTS]


def _numbers(values: object, most: float, name: str, count: int = NUM_JOINTS) -> Array:
    """(count,) finite numbers within +-``most``."""
    if not isinstance(values, list) or len(values) != count:
        raise Garbled(f"{name} is not {count} numbers")
    if not {float, int}.issuperset(map(type, values)):
        raise Garbled(f"{name} holds something else than numbers")
    try:
        array = np.array(values, np.float64)
    except OverflowError as error:
        raise Garbled(f"{name} holds a number beyond all bounds") from error
    if not (np.abs(array) <= most).all():
        raise Garbled(f"{name} is not finite or beyond {most:g}")
    return array


def _mode(data: dict[str, Any], name: str) -> int:
    mode = data.get(name)
    if type(mode) is not int or not 0 <= mode <= 255:
        raise Garbled(f"{name} is no number from 0 to 255")
    return mode


def _remote(text: object) -> bytes:
    if not isinstance(text, str):
        raise Garbled("wireless_remote is no text")
    try:
        return base64.b64decode(text, validate=True)
    except ValueError as error:
        raise Garbled("wireless_remote is not base64") from error


def _roll_pitch_yaw(quaternion: Array) -> list[float]:
    """(3,) rad of a unit quaternion wxyz."""
    w, x, y, z = quaternion.tolist()
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return [float(roll), float(pitch), float(yaw)]
