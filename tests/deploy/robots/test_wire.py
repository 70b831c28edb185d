"""Compatibility with LeRobot's bridge, and rejection of everything else."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from lerobot.robots.unitree_g1.g1_utils import G1_29_JointIndex
from lerobot.robots.unitree_g1.unitree_sdk2_socket import LowStateMsg

from egovcp.log.tick import MotorReadings
from egovcp.robot.kinematics import TARGET_HIGH, TARGET_LOW
from egovcp.spec import JOINT_NAMES
from egovcp_deploy.robots.base import LowState, MotorCommand
from egovcp_deploy.robots.wire import (
    COMMAND_TOPIC,
    MOTOR_SLOTS,
    MalformedMessage,
    RemoteControl,
    decode_command,
    decode_state,
    encode_command,
    encode_state,
    fault_text,
)

GRAVITY = np.array([0.0, 0.0, 9.81])
COUNT = np.arange(29.0)
INDEX = np.arange(29)
TARGETS = TARGET_LOW + COUNT / 28 * (TARGET_HIGH - TARGET_LOW)
FULL = MotorReadings(
    torque=INDEX / 2.0,
    temperature=np.stack([30.0 + INDEX, 40.0 + INDEX], axis=1),
    faults=np.where(INDEX == 3, 0x80000000, 0),
    enabled=INDEX != 3,
)


def command(**changes: Any) -> MotorCommand:
    fields = {"position": TARGETS, "stiffness": COUNT + 50, "damping": COUNT / 7, "mode": 5}
    return MotorCommand(**(fields | changes))


def reading() -> LowState:
    quaternion = np.array([0.9, 0.1, -0.3, 0.2])
    return LowState(
        time_ns=7,
        joint_position=COUNT / 10,
        joint_velocity=-COUNT,
        quaternion_w=quaternion / np.linalg.norm(quaternion),
        angular_velocity=np.array([0.1, 0.2, 0.3]),
        mode=5,
        remote=RemoteControl(ly=0.5).to_bytes(),
        motors=MotorReadings(COUNT * 2),
    )


def changed(payload: bytes, path: tuple[Any, ...], value: Any) -> bytes:
    message = json.loads(payload)
    place = message
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return json.dumps(message).encode()


def test_joints_are_numbered_as_in_lerobot() -> None:
    def words(name: str) -> list[str]:
        return ["".join(c.lower() for c in name if c.isalpha())]

    ours = [words(name.removesuffix("_joint")) for name in JOINT_NAMES]
    theirs = [words(index.name.removeprefix("k")) for index in sorted(G1_29_JointIndex)]
    assert [index.value for index in sorted(G1_29_JointIndex)] == list(range(len(JOINT_NAMES)))
    assert ours == theirs


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Any:
    """LeRobot's bridge, without the SDK of the robot that it runs on."""
    parts = (
        "comm.motion_switcher.motion_switcher_client",
        "core.channel",
        "idl.default",
        "idl.unitree_hg.msg.dds_",
        "utils.crc",
    )
    for part in parts:
        name = "unitree_sdk2py"
        monkeypatch.setitem(sys.modules, name, MagicMock(spec=ModuleType))
        for piece in part.split("."):
            name += f".{piece}"
            monkeypatch.setitem(sys.modules, name, MagicMock())
    name = "lerobot.robots.unitree_g1.run_g1_server"
    monkeypatch.delitem(sys.modules, name, raising=False)
    module = importlib.import_module(name)
    monkeypatch.delitem(sys.modules, name)
    return module


def test_lerobots_bridge_reads_our_commands(server: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    blank = SimpleNamespace(motor_cmd=[SimpleNamespace() for _ in range(MOTOR_SLOTS)])
    monkeypatch.setattr(server, "unitree_hg_msg_dds__LowCmd_", lambda: blank)
    message = json.loads(encode_command(command()))
    assert message["topic"] == server.kTopicLowCommand_Debug == COMMAND_TOPIC
    understood = server.dict_to_lowcmd(message["data"])
    motors = understood.motor_cmd
    assert (understood.mode_pr, understood.mode_machine) == (0, 5)
    assert [m.mode for m in motors] == [1] * 29 + [0] * 6
    np.testing.assert_array_equal([m.q for m in motors[:29]], command().position)
    np.testing.assert_array_equal([m.kp for m in motors[:29]], command().stiffness)
    np.testing.assert_array_equal([m.kd for m in motors[:29]], command().damping)
    assert {(m.dq, m.tau) for m in motors} == {(0.0, 0.0)}
    assert {(m.q, m.kp, m.kd) for m in motors[29:]} == {(0.0, 0.0, 0.0)}


def test_we_read_what_lerobots_bridge_sends(server: Any) -> None:
    motors = [
        SimpleNamespace(q=i / 10, dq=-i, tau_est=2 * i, temperature=[30, 40])
        for i in range(MOTOR_SLOTS)
    ]
    imu = SimpleNamespace(
        quaternion=[1, 0, 0, 0],
        gyroscope=[1, 2, 3],
        accelerometer=[0, 0, 9.81],
        rpy=[0, 0, 0],
        temperature=30,
    )
    remote = RemoteControl(lx=0.25).to_bytes()
    sent = SimpleNamespace(motor_state=motors, imu_state=imu, wireless_remote=remote)
    sent.mode_machine = 5
    payload = json.dumps({"topic": server.kTopicLowState, "data": server.lowstate_to_dict(sent)})
    got = decode_state(payload.encode(), 11)
    np.testing.assert_array_equal(got.joint_position, COUNT / 10)
    np.testing.assert_array_equal(got.joint_velocity, -COUNT)
    np.testing.assert_array_equal(got.motors.torque, 2 * COUNT)
    np.testing.assert_array_equal(got.angular_velocity, [1, 2, 3])
    assert (got.mode, got.time_ns) == (5, 11)
    assert RemoteControl.parse(got.remote) == RemoteControl(lx=0.25)


def test_lerobots_client_reads_our_states() -> None:
    state = reading()
    message = LowStateMsg(json.loads(encode_state(state, GRAVITY))["data"])
    assert [m.q for m in message.motor_state[:29]] == state.joint_position.tolist()
    assert [m.dq for m in message.motor_state[:29]] == state.joint_velocity.tolist()
    assert [m.tau_est for m in message.motor_state[:29]] == state.motors.torque.tolist()
    assert len(message.motor_state) == MOTOR_SLOTS
    assert message.imu_state.quaternion == state.quaternion_w.tolist()
    assert message.imu_state.gyroscope == state.angular_velocity.tolist()
    assert message.wireless_remote == state.remote
    assert message.mode_machine == 5


def test_state_round_trip() -> None:
    state = reading()
    back = decode_state(encode_state(state, GRAVITY), 7)
    for name in ("joint_position", "joint_velocity", "angular_velocity"):
        np.testing.assert_array_equal(getattr(back, name), getattr(state, name))
    np.testing.assert_allclose(back.quaternion_w, state.quaternion_w, rtol=1e-12)
    np.testing.assert_array_equal(back.motors.torque, state.motors.torque)
    assert (back.mode, back.remote) == (5, state.remote)


def test_command_round_trip() -> None:
    back = decode_command(encode_command(command()))
    for name in ("position", "stiffness", "damping"):
        np.testing.assert_array_equal(getattr(back.motors, name), getattr(command(), name))
    assert back.motors.mode == 5
    assert back.enabled.all()
    assert back.series
    assert not back.velocity.any()
    assert not back.torque.any()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"position": np.full(29, np.nan)}, "position of left_hip_pitch_joint is nan, expected -"),
        ({"position": np.full(29, np.inf)}, "is inf"),
        ({"position": np.full(29, 1e9)}, "is 1e+09, expected -10 to 10"),
        ({"position": np.zeros(28)}, "position has shape (28,), expected (29,)"),
        ({"position": TARGETS - 0.01 * (COUNT == 0)}, "target of left_hip_pitch_joint is"),
        ({"position": TARGETS + 0.01 * (COUNT == 28)}, "target of right_wrist_yaw_joint is"),
        ({"stiffness": np.full(29, -1.0)}, "stiffness of left_hip_pitch_joint is -1, expected 0"),
        ({"damping": np.where(COUNT == 3, -np.inf, 1.0)}, "damping of left_knee_joint is -inf"),
        ({"damping": np.full(29, 1e9)}, "is 1e+09, expected 0 to 10000"),
    ],
)
def test_an_invalid_command_is_not_encoded(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(MalformedMessage, match=re.escape(words)):
        encode_command(command(**changes))


Q3 = ("data", "motor_state", 3, "q")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("topic",), "rt/other"),
        (("data",), []),
        (("data", "motor_state"), [{}] * 29),
        (("data", "motor_state"), "35 motors"),
        (("data", "motor_state", 3), None),
        (Q3, None),
        (Q3, True),
        (Q3, "0.1"),
        (Q3, [0.1]),
        (Q3, float("nan")),
        (Q3, float("-inf")),
        (Q3, 1e308),
        (Q3, 10**4000),
        (("data", "imu_state"), None),
        (("data", "imu_state", "quaternion"), [0, 0, 0, 0]),
        (("data", "imu_state", "quaternion"), [1, 0, 0]),
        (("data", "imu_state", "gyroscope"), {"x": 0}),
        (("data", "wireless_remote"), "not base64!"),
        (("data", "wireless_remote"), 3),
        (("data", "mode_machine"), -1),
        (("data", "mode_machine"), 5.0),
    ],
)
def test_an_invalid_state_is_malformed(path: tuple[Any, ...], value: Any) -> None:
    with pytest.raises(MalformedMessage):
        decode_state(changed(encode_state(reading(), GRAVITY), path, value), 0)


@pytest.mark.parametrize(
    "payload",
    [b"", b"\xff\xfe", b"null", b"[" * 60_000, b"9" * 60_000, b" " * 10**6, b'{"topic": "rt/lo'],
)
def test_invalid_bytes_are_malformed(payload: bytes) -> None:
    for decode in (lambda raw: decode_state(raw, 0), decode_command):
        with pytest.raises(MalformedMessage):
            decode(payload)


def test_mutated_messages_are_decoded_or_malformed() -> None:
    rng = np.random.default_rng(0)
    payloads = (encode_state(reading(), GRAVITY), encode_command(command()))
    for _ in range(2000):
        for original, decode in zip(
            payloads, (lambda raw: decode_state(raw, 0), decode_command), strict=True
        ):
            raw = bytearray(original)
            for _ in range(rng.integers(1, 6)):
                raw[rng.integers(len(raw))] = rng.integers(256)
            try:
                got: Any = decode(bytes(raw[: rng.integers(len(raw) // 2, 2 * len(raw))]))
            except MalformedMessage:
                continue
            arrays = vars(got if isinstance(got, LowState) else got.motors).values()
            assert all(np.isfinite(a).all() for a in arrays if isinstance(a, np.ndarray))


def test_remote_control_round_trip() -> None:
    remote = RemoteControl(0.5, -0.25, 1.0, -1.0, frozenset({"A", "R1", "left"}))
    raw = remote.to_bytes()
    assert len(raw) == 40
    assert RemoteControl.parse(raw) == remote


def test_buttons_have_the_order_of_lerobot() -> None:
    bits = {"R1": 0, "L1": 1, "start": 2, "R2": 4, "L2": 5, "A": 8, "Y": 11, "up": 12, "left": 15}
    for name, bit in bits.items():
        raw = bytearray(40)
        raw[2:4] = (1 << bit).to_bytes(2, "little")
        assert RemoteControl.parse(bytes(raw)) == RemoteControl(pressed=frozenset({name}))


@pytest.mark.parametrize("raw", [b"", b"\x00" * 39, b"\xff" * 40, RemoteControl(lx=2.0).to_bytes()])
def test_an_invalid_remote_control_is_none(raw: bytes) -> None:
    assert RemoteControl.parse(raw) is None


def test_velocity_of_the_sticks() -> None:
    wish = np.array([0.3, -0.1, 0.25])
    np.testing.assert_allclose(RemoteControl.from_velocity(wish).velocity, wish)
    assert RemoteControl(ly=1.0).velocity[0] > 0, "forward"
    assert RemoteControl(lx=1.0).velocity[1] < 0, "right"
    assert RemoteControl(rx=1.0).velocity[2] < 0, "clockwise"


def state_message(motors: MotorReadings = FULL) -> bytes:
    zero = np.zeros(29)
    state = LowState(0, zero, zero, np.array([1.0, 0, 0, 0]), np.zeros(3), motors=motors)
    return encode_state(state, GRAVITY)


def read_motors(payload: bytes) -> MotorReadings:
    motors = decode_state(payload, 1).motors
    assert motors is not None
    return motors


def with_motors(change: Callable[[dict[str, Any]], object]) -> MotorReadings:
    """Of the full message, after ``change`` of each motor."""
    parsed = json.loads(state_message())
    for motor in parsed["data"]["motor_state"]:
        change(motor)
    return read_motors(json.dumps(parsed).encode())


def test_optional_motor_fields_round_trip() -> None:
    back = read_motors(state_message())
    for name in ("torque", "temperature", "faults", "enabled"):
        np.testing.assert_array_equal(getattr(back, name), getattr(FULL, name))


def test_motor_field_names_are_those_of_unitree() -> None:
    motor = json.loads(state_message())["data"]["motor_state"][3]
    assert motor["temperature"] == [33.0, 43.0]
    assert (motor["motorstate"], motor["mode"]) == (0x80000000, 0)


def test_one_temperature_per_motor_is_accepted() -> None:
    back = with_motors(lambda motor: motor.update(temperature=41.5))
    np.testing.assert_array_equal(back.temperature, np.full((29, 1), 41.5))


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("temperature", "temperature"),
        ("motorstate", "faults"),
        ("mode", "enabled"),
    ],
)
def test_an_absent_motor_field_is_none(name: str, field: str) -> None:
    back = with_motors(lambda motor: motor.pop(name, None))
    fields = {"temperature", "faults", "enabled"}
    assert getattr(back, field) is None
    assert all(getattr(back, other) is not None for other in fields - {field})


@pytest.mark.parametrize("value", ["hot", None, [], [1, 2, 3], {}, True, 1e300, -1, 1.5])
def test_an_invalid_optional_field_keeps_the_reading(value: object) -> None:
    back = with_motors(lambda motor: motor.update(temperature=value, motorstate=value, mode=value))
    np.testing.assert_array_equal(back.torque, FULL.torque)
    assert back.faults is None
    assert back.enabled is None


def test_an_impossible_temperature_is_nan() -> None:
    back = with_motors(lambda motor: motor.update(temperature=[500.0, 43.0]))
    assert np.isnan(back.temperature[:, 0]).all()
    np.testing.assert_array_equal(back.temperature[:, 1], 43.0)


@pytest.mark.parametrize("zeros", [0.0, [0, 0]])
def test_all_zero_temperatures_are_none(zeros: object) -> None:
    assert with_motors(lambda motor: motor.update(temperature=zeros)).temperature is None


def test_status_bits_as_text() -> None:
    assert fault_text(0x200) == "winding overheating (0x200)"
    assert fault_text(0x201) == "overcurrent, winding overheating (0x201)"
    assert fault_text(0x100000) == "unknown (0x100000)"
