"""What goes over the wire is what LeRobot's bridge speaks, and nothing else is believed."""

from __future__ import annotations

import importlib
import json
import sys
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
from egovcp_deploy.robots.body import BodyState, MotorCommand
from egovcp_deploy.robots.remote import Remote
from egovcp_deploy.robots.wire import (
    COMMAND_TOPIC,
    MOTOR_SLOTS,
    Garbled,
    LowState,
    decode_command,
    decode_state,
    encode_command,
    encode_state,
)

GRAVITY = np.array([0.0, 0.0, 9.81])
COUNT = np.arange(29.0)
TARGETS = TARGET_LOW + COUNT / 28 * (TARGET_HIGH - TARGET_LOW)


def command(**changes: Any) -> MotorCommand:
    fields = {"position": TARGETS, "stiffness": COUNT + 50, "damping": COUNT / 7, "mode": 5}
    return MotorCommand(**(fields | changes))


def reading(sources: int | None = None) -> LowState:
    quaternion = np.array([0.9, 0.1, -0.3, 0.2])
    body = BodyState(
        time_ns=7,
        joint_position=COUNT / 10,
        joint_velocity=-COUNT,
        quaternion_w=quaternion / np.linalg.norm(quaternion),
        angular_velocity=np.array([0.1, 0.2, 0.3]),
        mode=5,
        remote=Remote(ly=0.5).to_bytes(),
        motors=MotorReadings(COUNT * 2),
    )
    return LowState(body, sources)


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
    remote = Remote(lx=0.25).to_bytes()
    sent = SimpleNamespace(motor_state=motors, imu_state=imu, wireless_remote=remote)
    sent.mode_machine = 5
    payload = json.dumps({"topic": server.kTopicLowState, "data": server.lowstate_to_dict(sent)})
    got = decode_state(payload.encode(), 11)
    np.testing.assert_array_equal(got.body.joint_position, COUNT / 10)
    np.testing.assert_array_equal(got.body.joint_velocity, -COUNT)
    np.testing.assert_array_equal(got.motors.torque, 2 * COUNT)
    np.testing.assert_array_equal(got.body.angular_velocity, [1, 2, 3])
    assert (got.body.mode, got.body.time_ns, got.sources) == (5, 11, None)
    assert Remote.parse(got.body.remote) == Remote(lx=0.25)


def test_lerobots_client_reads_our_states() -> None:
    state = reading()
    message = LowStateMsg(json.loads(encode_state(state, GRAVITY))["data"])
    assert [m.q for m in message.motor_state[:29]] == state.body.joint_position.tolist()
    assert [m.dq for m in message.motor_state[:29]] == state.body.joint_velocity.tolist()
    assert [m.tau_est for m in message.motor_state[:29]] == state.motors.torque.tolist()
    assert len(message.motor_state) == MOTOR_SLOTS
    assert message.imu_state.quaternion == state.body.quaternion_w.tolist()
    assert message.imu_state.gyroscope == state.body.angular_velocity.tolist()
    assert message.wireless_remote == state.body.remote
    assert message.mode_machine == 5


@pytest.mark.parametrize("sources", [None, 2])
def test_states_survive_the_wire(sources: int | None) -> None:
    state = reading(sources)
    back = decode_state(encode_state(state, GRAVITY), 7)
    for name in ("joint_position", "joint_velocity", "angular_velocity"):
        np.testing.assert_array_equal(getattr(back.body, name), getattr(state.body, name))
    np.testing.assert_allclose(back.body.quaternion_w, state.body.quaternion_w, rtol=1e-12)
    np.testing.assert_array_equal(back.motors.torque, state.motors.torque)
    assert (back.body.mode, back.body.remote) == (5, state.body.remote)
    assert back.sources == sources


def test_commands_survive_the_wire() -> None:
    back = decode_command(encode_command(command()))
    for name in ("position", "stiffness", "damping"):
        np.testing.assert_array_equal(getattr(back.motors, name), getattr(command(), name))
    assert back.motors.mode == 5
    assert back.enabled.all()
    assert back.series
    assert not back.velocity.any()
    assert not back.torque.any()


@pytest.mark.parametrize(
    "changes",
    [
        {"position": np.full(29, np.nan)},
        {"position": np.full(29, np.inf)},
        {"position": np.full(29, 1e9)},
        {"position": np.zeros(28)},
        {"position": TARGETS - 0.01 * (COUNT == 0)},
        {"position": TARGETS + 0.01 * (COUNT == 28)},
        {"stiffness": np.full(29, -1.0)},
        {"damping": np.full(29, -np.inf)},
        {"damping": np.full(29, 1e9)},
    ],
)
def test_an_impossible_command_is_never_encoded(changes: dict[str, Any]) -> None:
    with pytest.raises(Garbled):
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
        (("data", "command_sources"), "two"),
    ],
)
def test_a_state_that_makes_no_sense_is_garbled(path: tuple[Any, ...], value: Any) -> None:
    with pytest.raises(Garbled):
        decode_state(changed(encode_state(reading(), GRAVITY), path, value), 0)


@pytest.mark.parametrize(
    "payload",
    [b"", b"\xff\xfe", b"null", b"[" * 60_000, b"9" * 60_000, b" " * 10**6, b'{"topic": "rt/lo'],
)
def test_bytes_that_are_no_message_are_garbled(payload: bytes) -> None:
    for decode in (lambda raw: decode_state(raw, 0), decode_command):
        with pytest.raises(Garbled):
            decode(payload)


def test_mutated_messages_are_read_or_garbled_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    payloads = (encode_state(reading(2), GRAVITY), encode_command(command()))
    for _ in range(2000):
        for original, decode in zip(
            payloads, (lambda raw: decode_state(raw, 0), decode_command), strict=True
        ):
            raw = bytearray(original)
            for _ in range(rng.integers(1, 6)):
                raw[rng.integers(len(raw))] = rng.integers(256)
            try:
                got: Any = decode(bytes(raw[: rng.integers(len(raw) // 2, 2 * len(raw))]))
            except Garbled:
                continue
            arrays = vars(got.body if isinstance(got, LowState) else got.motors).values()
            assert all(np.isfinite(a).all() for a in arrays if isinstance(a, np.ndarray))


def test_the_remote_control_survives_the_wire() -> None:
    remote = Remote(0.5, -0.25, 1.0, -1.0, frozenset({"A", "R1", "left"}))
    raw = remote.to_bytes()
    assert len(raw) == 40
    assert Remote.parse(raw) == remote


def test_buttons_have_the_order_of_lerobot() -> None:
    bits = {"R1": 0, "L1": 1, "start": 2, "R2": 4, "L2": 5, "A": 8, "Y": 11, "up": 12, "left": 15}
    for name, bit in bits.items():
        raw = bytearray(40)
        raw[2:4] = (1 << bit).to_bytes(2, "little")
        assert Remote.parse(bytes(raw)) == Remote(pressed=frozenset({name}))


@pytest.mark.parametrize("raw", [b"", b"\x00" * 39, b"\xff" * 40, Remote(lx=2.0).to_bytes()])
def test_a_remote_control_that_makes_no_sense_is_none(raw: bytes) -> None:
    assert Remote.parse(raw) is None


def test_sticks_ask_for_a_velocity() -> None:
    wish = np.array([0.3, -0.1, 0.25])
    np.testing.assert_allclose(Remote.asking_for(wish).velocity, wish)
    assert Remote(ly=1.0).velocity[0] > 0, "forward"
    assert Remote(lx=1.0).velocity[1] < 0, "right"
    assert Remote(rx=1.0).velocity[2] < 0, "clockwise"
