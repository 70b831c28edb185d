"""`BridgeRobot` against a fake G1: it never blocks and never repeats a reading as new."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
import zmq

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.robot.g1 import DAMPING, STIFFNESS
from egovcp_deploy.robots import wire
from egovcp_deploy.robots.base import MotorCommand
from egovcp_deploy.robots.bridge import BridgeConfig, BridgeRobot, mode_refusal, mode_warning
from egovcp_deploy.robots.fake.bridge import MODE, FakeBridge
from egovcp_deploy.robots.wire import encode_command
from egovcp_deploy.robots.zmq_camera import ZmqCameraConfig, ZmqDepthCamera
from tests.support.ports import free_port
from tests.support.robots.fake_g1 import FakeG1Thread, bridge_config, eventually
from tests.support.robots.fault_messages import KNEE, Edit, edited, gyroscope, motor

ZERO = np.zeros(29)
DAMP = MotorCommand(ZERO, ZERO, DAMPING, MODE)


def hold(robot: BridgeRobot) -> MotorCommand:
    """A command that holds the current pose."""
    state = robot.read()
    assert state is not None
    return MotorCommand(state.joint_position, STIFFNESS, DAMPING, state.mode)


def test_readings_have_their_time_of_arrival(robot: BridgeRobot, running: FakeG1Thread) -> None:
    first = robot.read()
    assert first is not None
    assert eventually(lambda: robot.read() is not first)
    second = robot.read()
    assert second is not None
    assert first.time_ns < second.time_ns <= time.monotonic_ns()
    running.stop()
    joints = running.fake.robot.robot.data.qpos[running.fake.robot.robot.index.joint_qpos]
    np.testing.assert_allclose(robot.read().joint_position, joints, atol=0.05)
    assert second.mode == MODE


def test_commands_reach_the_motors(robot: BridgeRobot, running: FakeG1Thread) -> None:
    fake = running.fake

    def commanded() -> bool:
        robot.write(hold(robot))
        return fake.commanded

    assert eventually(commanded)


def test_write_still_works_after_stop_receiving(robot: BridgeRobot, running: FakeG1Thread) -> None:
    robot.stop_receiving()
    last = robot.read()
    received: list[bytes] = []
    running.fake.on_command = received.append

    def commanded() -> bool:
        robot.write(hold(robot))
        return len(received) > 20 and running.fake.commanded  # it knows the robot's mode

    assert eventually(commanded)
    assert robot.read() is last
    robot.close()


def test_read_returns_the_last_reading_without_messages(
    robot: BridgeRobot, running: FakeG1Thread
) -> None:
    running.fake.faults.stop_state = True
    time.sleep(0.1)
    last = robot.read()
    time.sleep(0.1)
    assert robot.read() is last


def test_repeated_readings_are_ignored(fake: FakeBridge) -> None:
    robot, payload = BridgeRobot(), fake._encode_state()
    assert robot._handle(payload, 1, 0)
    assert not robot._handle(payload, 2, 0)
    assert robot.read().time_ns == 1


def test_truncated_messages_are_dropped(robot: BridgeRobot, running: FakeG1Thread) -> None:
    running.fake.faults.truncate_state = True
    assert eventually(lambda: robot._malformed > 3)
    assert "JSON" in robot._rejection
    for _ in range(3):
        last = robot.read()
        assert eventually(lambda last=last: robot.read() is not last)


def test_an_unforeseen_error_rejects_its_message_and_reading_goes_on(
    robot: BridgeRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The runner holds and damps with this reason if every message fails."""
    with monkeypatch.context() as broken:
        broken.setattr(wire, "decode_state", lambda payload, time_ns: 1 // 0)
        assert eventually(lambda: "ZeroDivisionError" in robot.rejected)
        last = robot.read()
    assert eventually(lambda: robot.read() is not last and not robot.rejected)


def test_an_invalid_command_is_not_sent(robot: BridgeRobot, running: FakeG1Thread) -> None:
    received: list[bytes] = []
    running.fake.on_command = received.append
    robot.write(MotorCommand(np.full(29, np.nan), STIFFNESS, DAMPING, MODE))
    robot.write(MotorCommand(ZERO, -STIFFNESS, DAMPING, MODE))
    robot.write(DAMP)
    assert eventually(lambda: bool(received))
    assert received == [encode_command(DAMP)]


def test_commands_without_a_connection_are_dropped(
    robot: BridgeRobot, running: FakeG1Thread
) -> None:
    running.stop()
    ports = running.fake.ports
    running.fake.close()

    def dropped() -> bool:
        robot.write(DAMP)
        return not robot._commands.poll(0, zmq.POLLOUT)

    assert eventually(dropped)
    robot.write(DAMP)
    with zmq.Context() as context, context.socket(zmq.PULL) as bridge:
        bridge.bind(f"tcp://{ports.host}:{ports.command_port}")
        assert not bridge.poll(500), "an old command must not reach a restarted bridge"

        def sent() -> bool:
            robot.write(DAMP)
            return bool(bridge.poll(0))

        assert eventually(sent)


def test_readings_resume_after_a_restart_of_the_bridge(
    robot: BridgeRobot, running: FakeG1Thread
) -> None:
    running.stop()
    fake, ports = running.fake, running.fake.ports
    fake.close()
    last = robot.read()
    revived = FakeBridge(fake.robot, ports)
    again = FakeG1Thread(revived)
    try:
        assert eventually(lambda: robot.read() is not last)
    finally:
        again.stop()
        revived.close()


def test_connect_reports_a_missing_bridge() -> None:
    port = free_port()
    robot = BridgeRobot(BridgeConfig(state_port=port, command_port=port))
    with pytest.raises(EnvironmentFailure, match=rf"nothing at 127.0.0.1:{port}.*run_g1_server"):
        robot.connect(0.1)
    assert robot.read() is None
    robot.close()


@pytest.fixture
def publisher() -> Iterator[zmq.Socket[bytes]]:
    with zmq.Context() as context, context.socket(zmq.PUB) as end:
        end.bind("tcp://127.0.0.1:*")
        yield end


def config_for(publisher: zmq.Socket[bytes]) -> BridgeConfig:
    port = int(publisher.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
    return BridgeConfig(state_port=port, command_port=port)


def test_connect_reports_a_bridge_without_states(publisher: zmq.Socket[bytes]) -> None:
    with pytest.raises(EnvironmentFailure, match="something listens there"):
        BridgeRobot(config_for(publisher)).connect(0.1)


def test_connect_reports_another_service(publisher: zmq.Socket[bytes]) -> None:
    robot = BridgeRobot(config_for(publisher))
    robot._open()
    count = iter(range(100_000))

    def garbled() -> bool:
        publisher.send(b'{"images": %d}' % next(count))
        return robot._malformed > 0

    assert eventually(garbled)
    assert "none a state of a G1" in robot._timeout_reason(1.0)
    robot.close()


def test_readings_resume_after_oversized_messages(
    publisher: zmq.Socket[bytes], fake: FakeBridge
) -> None:
    robot = BridgeRobot(config_for(publisher))
    robot._open()
    for _ in range(100):
        publisher.send(b"x" * 1_000_000)
        time.sleep(0.005)

    def heard() -> bool:
        publisher.send(fake._encode_state())
        return robot.read() is not None

    assert eventually(heard)
    robot.close()


def test_connect_reports_an_unknown_host() -> None:
    with pytest.raises(EnvironmentFailure, match=r"g1\.invalid:6001 \(unknown host name"):
        BridgeRobot(BridgeConfig(host="g1.invalid")).connect(0.1)


@pytest.mark.parametrize("host", ["", "a b", "*", "tcp://127.0.0.1", "g1" * 100])
def test_connect_reports_an_invalid_address(host: str) -> None:
    with pytest.raises(EnvironmentFailure, match=r"not a valid address|unknown host name"):
        BridgeRobot(BridgeConfig(host=host)).connect(0.1)
    with pytest.raises(EnvironmentFailure, match=r"not a valid address|no depth camera"):
        ZmqDepthCamera(ZmqCameraConfig(host=host)).connect(0.1)


def test_ports_are_checked() -> None:
    with pytest.raises(UsageError, match="65535"):
        BridgeConfig(state_port=70_000)


def test_another_mode_is_refused(running: FakeG1Thread) -> None:
    with pytest.raises(EnvironmentFailure, match=f"mode machine {MODE}, expected 4"):
        BridgeRobot(bridge_config(running.fake, mode=4)).connect()


def test_a_changed_mode_refuses_arming(robot: BridgeRobot, running: FakeG1Thread) -> None:
    assert eventually(lambda: not robot.refusal)
    running.fake.faults.mode = 9
    assert eventually(lambda: "mode machine 9" in robot.refusal)


def test_a_lasting_mode_change_is_a_fault(robot: BridgeRobot, running: FakeG1Thread) -> None:
    assert eventually(lambda: robot.read() is not None)
    assert not robot.fault
    running.fake.faults.mode = 4
    assert eventually(lambda: robot.fault == f"the mode machine changed from {MODE} to 4")
    running.fake.faults.mode = None
    assert eventually(lambda: not robot.fault)


@pytest.mark.parametrize("mode", [4, 6, 9])
def test_a_robot_without_29_joints_or_with_a_locked_waist_is_refused(
    running: FakeG1Thread, mode: int
) -> None:
    running.fake.faults.mode = mode
    with pytest.raises(EnvironmentFailure, match=f"mode machine {mode} is a G1"):
        BridgeRobot(bridge_config(running.fake)).connect()


def test_a_locked_waist_is_accepted_if_it_is_named(running: FakeG1Thread) -> None:
    running.fake.faults.mode = 6
    robot = BridgeRobot(bridge_config(running.fake, mode=6))
    robot.connect()
    assert "the waist is locked" in robot.warning
    robot.close()


def test_modes_that_differ_from_the_controllers_assumptions_give_a_warning() -> None:
    assert mode_refusal(5, False) == mode_warning(5) == ""
    assert mode_refusal(77, False) == ""
    assert "not known" in mode_warning(77)
    assert "gear is 22.5" in mode_warning(11)
    assert "waist is locked" in mode_warning(12)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (gyroscope(150.0), "gyroscope x (rad/s) is 150.00"),
        (motor(KNEE, "dq", lambda dq: 190.0), "left_knee_joint speed (rad/s) is 190.00"),
    ],
)
def test_implausible_readings_are_rejected_and_counted(
    robot: BridgeRobot, running: FakeG1Thread, edit: Edit, words: str
) -> None:
    assert eventually(lambda: robot.read() is not None)
    unaltered, running.fake.alter_state = running.fake.alter_state, edited(edit)
    assert eventually(lambda: robot._implausible > 3)
    seen = robot.read()
    assert words in robot.rejected
    assert eventually(lambda: robot._implausible > 6)
    assert robot.read() is seen
    running.fake.alter_state = unaltered
    assert eventually(lambda: not robot.rejected)


def test_arming_is_allowed_without_commands(robot: BridgeRobot) -> None:
    assert "listening" in robot.refusal
    assert eventually(lambda: not robot.refusal)


def test_arming_is_allowed_if_motors_follow_our_commands(robot: BridgeRobot) -> None:
    for _ in range(60):
        robot.write(hold(robot))
        time.sleep(0.02)
    assert robot.refusal == ""


def test_arming_is_refused_if_another_program_commands(
    robot: BridgeRobot, running: FakeG1Thread
) -> None:
    other = BridgeRobot(bridge_config(running.fake))
    other.connect()
    askew = hold(other)
    askew = MotorCommand(askew.position + 0.2, askew.stiffness, askew.damping, askew.mode)

    def noticed() -> bool:
        other.write(askew)
        return "does not follow our commands" in robot.refusal

    assert eventually(noticed)
    other.close()


def test_alternating_publishers_are_detected(robot: BridgeRobot, running: FakeG1Thread) -> None:
    other = BridgeRobot(bridge_config(running.fake))
    other.connect()
    askew = hold(other)
    askew = MotorCommand(askew.position + 0.3, askew.stiffness, askew.damping, askew.mode)

    def noticed() -> bool:
        robot.write(DAMP)
        time.sleep(0.01)
        other.write(askew)
        time.sleep(0.01)
        return "does not follow our commands" in robot.refusal

    assert eventually(noticed)
    other.close()


def test_a_constant_publisher_is_detected(robot: BridgeRobot, running: FakeG1Thread) -> None:
    running.fake.faults.other_publisher = True
    assert eventually(lambda: "does not follow our commands" in robot.refusal)


def test_close_may_be_called_twice(robot: BridgeRobot) -> None:
    robot.close()
    robot.close()
