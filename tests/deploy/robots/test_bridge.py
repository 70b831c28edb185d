"""The body behind the bridge: never blocks, never passes off an old reading as new."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
import zmq

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.robot.g1 import DAMPING, STIFFNESS
from egovcp_deploy.robots.body import MotorCommand
from egovcp_deploy.robots.bridge import BridgeBody, BridgeConfig
from egovcp_deploy.robots.fake import FakeBridge
from egovcp_deploy.robots.fake.bridge import MODE
from egovcp_deploy.robots.fake.running import Running, config_of, eventually
from egovcp_deploy.robots.zmq_eye import ZmqEye, ZmqEyeConfig
from tests.support.ports import free_port

ZERO = np.zeros(29)
DAMP = MotorCommand(ZERO, ZERO, DAMPING, MODE)


def hold(body: BridgeBody) -> MotorCommand:
    """Stay where it is."""
    state = body.read()
    assert state is not None
    return MotorCommand(state.joint_position, STIFFNESS, DAMPING, state.mode)


def test_readings_arrive_and_are_stamped_on_our_clock(body: BridgeBody, running: Running) -> None:
    first = body.read()
    assert first is not None
    assert eventually(lambda: body.read() is not first)
    second = body.read()
    assert second is not None
    assert first.time_ns < second.time_ns <= time.monotonic_ns()
    running.stop()
    joints = running.fake.robot.robot.data.qpos[running.fake.robot.robot.index.joint_qpos]
    np.testing.assert_allclose(body.read().joint_position, joints, atol=0.05)
    assert second.mode == MODE


def test_commands_reach_the_motors(body: BridgeBody, running: Running) -> None:
    fake = running.fake

    def commanded() -> bool:
        body.write(hold(body))
        return fake.commanded

    assert eventually(commanded)
    assert body.traffic.sent > 0
    assert fake.counts.ignored == fake.counts.garbled == 0


def test_a_deaf_body_hears_nothing_more_and_still_reaches_the_motors(
    body: BridgeBody, running: Running
) -> None:
    body.deafen()
    last, heard = body.read(), body.traffic.readings
    before = running.fake.counts.commands

    def commanded() -> bool:
        body.write(hold(body))
        return running.fake.counts.commands > before + 20

    assert eventually(commanded)
    assert body.read() is last
    assert body.traffic.readings == heard
    assert running.fake.counts.ignored == 0  # it knows the robot's mode
    body.close()


def test_silence_is_not_news(body: BridgeBody, running: Running) -> None:
    running.fake.faults.mute_state = True
    time.sleep(0.1)
    last = body.read()
    time.sleep(0.1)
    assert body.read() is last


def test_the_same_reading_again_is_not_news(body: BridgeBody, running: Running) -> None:
    running.fake.faults.freeze_state = True
    assert eventually(lambda: body.traffic.repeated > 3)
    last = body.read()
    seen = body.traffic.repeated
    assert eventually(lambda: body.traffic.repeated > seen + 3)
    assert body.read() is last


def test_torn_messages_are_dropped_and_counted(body: BridgeBody, running: Running) -> None:
    running.fake.faults.garble_state = True
    assert eventually(lambda: body.traffic.garbled > 3)
    good = body.traffic.readings
    assert eventually(lambda: body.traffic.readings > good + 3)
    assert "JSON" in body.traffic.problem


def test_an_impossible_command_is_not_sent(body: BridgeBody) -> None:
    body.write(MotorCommand(np.full(29, np.nan), STIFFNESS, DAMPING, MODE))
    body.write(MotorCommand(ZERO, -STIFFNESS, DAMPING, MODE))
    assert body.traffic.refused == 2
    assert body.traffic.sent == 0


def test_writing_to_nobody_is_counted_and_nothing_waits_for_a_return(
    body: BridgeBody, running: Running
) -> None:
    running.stop()
    ports = running.fake.ports
    running.fake.close()

    def dropped() -> bool:
        body.write(DAMP)
        return body.traffic.dropped > 0

    assert eventually(dropped)
    with zmq.Context() as context, context.socket(zmq.PULL) as robot:
        robot.bind(f"tcp://{ports.host}:{ports.command_port}")
        assert not robot.poll(500), "a command from before must not reach a robot that came back"
        before = body.traffic.sent

        def sent() -> bool:
            body.write(DAMP)
            return body.traffic.sent > before

        assert eventually(sent)
        assert robot.poll(2000)


def test_a_robot_that_is_back_is_heard_again(body: BridgeBody, running: Running) -> None:
    running.stop()
    fake, ports = running.fake, running.fake.ports
    fake.close()
    last = body.read()
    revived = FakeBridge(fake.robot, ports)
    again = Running(revived)
    try:
        assert eventually(lambda: body.read() is not last)
    finally:
        again.stop()
        revived.close()


def test_no_bridge_is_a_clear_failure() -> None:
    port = free_port()
    body = BridgeBody(BridgeConfig(state_port=port, command_port=port))
    with pytest.raises(EnvironmentFailure, match=rf"nothing at 127.0.0.1:{port}.*run_g1_server"):
        body.connect(0.1)
    assert body.read() is None
    body.close()


@pytest.fixture
def publisher() -> Iterator[zmq.Socket[bytes]]:
    with zmq.Context() as context, context.socket(zmq.PUB) as end:
        end.bind("tcp://127.0.0.1:*")
        yield end


def config_for(publisher: zmq.Socket[bytes]) -> BridgeConfig:
    port = int(publisher.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])
    return BridgeConfig(state_port=port, command_port=port)


def test_a_silent_bridge_is_told_from_none(publisher: zmq.Socket[bytes]) -> None:
    with pytest.raises(EnvironmentFailure, match="something listens there"):
        BridgeBody(config_for(publisher)).connect(0.1)


def test_another_service_is_told_from_a_bridge(publisher: zmq.Socket[bytes]) -> None:
    body = BridgeBody(config_for(publisher))
    body._open()
    count = iter(range(100_000))

    def garbled() -> bool:
        publisher.send(b'{"images": %d}' % next(count))
        return body.traffic.garbled > 0

    assert eventually(garbled)
    assert "none a state of a G1" in body._diagnosis(1.0)
    body.close()


def test_a_message_of_any_size_ends_nothing(publisher: zmq.Socket[bytes], fake: FakeBridge) -> None:
    body = BridgeBody(config_for(publisher))
    body._open()
    for _ in range(100):
        publisher.send(b"x" * 1_000_000)
        time.sleep(0.005)

    def heard() -> bool:
        publisher.send(fake._state())
        return body.read() is not None

    assert eventually(heard)
    body.close()


def test_a_name_nobody_has_is_said() -> None:
    with pytest.raises(EnvironmentFailure, match=r"g1\.invalid:6001 \(no machine has that name"):
        BridgeBody(BridgeConfig(host="g1.invalid")).connect(0.1)


@pytest.mark.parametrize("host", ["", "a b", "*", "tcp://127.0.0.1", "g1" * 100])
def test_what_is_no_address_is_said(host: str) -> None:
    with pytest.raises(EnvironmentFailure, match=r"is no address|no machine has"):
        BridgeBody(BridgeConfig(host=host)).connect(0.1)
    with pytest.raises(EnvironmentFailure, match=r"is no address|no depth camera"):
        ZmqEye(ZmqEyeConfig(host=host)).connect(0.1)


def test_ports_are_ports() -> None:
    with pytest.raises(UsageError, match="65535"):
        BridgeConfig(state_port=70_000)


def test_another_robot_is_refused(running: Running) -> None:
    with pytest.raises(EnvironmentFailure, match=f"mode machine {MODE}, expected 4"):
        BridgeBody(config_of(running.fake, mode=4)).connect()


def test_a_mode_that_changes_is_trouble(body: BridgeBody, running: Running) -> None:
    assert eventually(lambda: not body.trouble)
    running.fake.faults.mode = 9
    assert eventually(lambda: "mode machine 9" in body.trouble)


def test_a_mode_that_changes_for_long_is_a_fault(body: BridgeBody, running: Running) -> None:
    assert eventually(lambda: body.read() is not None)
    assert not body.fault
    running.fake.faults.mode = 4
    assert eventually(lambda: body.fault == f"the mode machine changed from {MODE} to 4")
    running.fake.faults.mode = None
    assert eventually(lambda: not body.fault)


@pytest.mark.parametrize("mode", [4, 6, 9])
def test_a_robot_without_29_joints_or_with_a_locked_waist_is_refused(
    running: Running, mode: int
) -> None:
    running.fake.faults.mode = mode
    with pytest.raises(EnvironmentFailure, match=f"mode machine {mode} is a G1"):
        BridgeBody(config_of(running.fake)).connect()


def test_a_locked_waist_is_accepted_if_it_is_named(running: Running) -> None:
    running.fake.faults.mode = 6
    body = BridgeBody(config_of(running.fake, mode=6))
    body.connect()
    assert "the waist is locked" in body.warning
    body.close()


@pytest.mark.parametrize(
    ("fault", "value", "words"),
    [
        ("gyroscope", 150.0, "gyroscope x (rad/s) is 150.00"),
        ("joint_speed", 190.0, "left_knee_joint speed (rad/s) is 190.00"),
    ],
)
def test_false_sensors_are_skipped_and_counted(
    body: BridgeBody, running: Running, fault: str, value: float, words: str
) -> None:
    assert eventually(lambda: body.read() is not None)
    setattr(running.fake.faults, fault, value)
    assert eventually(lambda: body.traffic.implausible > 3)
    seen = body.read()
    assert words in body.skipped
    assert eventually(lambda: body.traffic.implausible > 6)
    assert body.read() is seen
    running.fake.faults.obey("heal")
    assert eventually(lambda: not body.skipped)


def test_a_robot_left_alone_may_be_armed(body: BridgeBody) -> None:
    assert "listening" in body.trouble
    assert eventually(lambda: not body.trouble)


def test_a_robot_that_obeys_us_may_be_armed(body: BridgeBody) -> None:
    for _ in range(60):
        body.write(hold(body))
        time.sleep(0.02)
    assert body.trouble == ""


def test_a_robot_that_obeys_another_program_may_not(body: BridgeBody, running: Running) -> None:
    other = BridgeBody(config_of(running.fake))
    other.connect()
    askew = hold(other)
    askew = MotorCommand(askew.position + 0.2, askew.stiffness, askew.damping, askew.mode)

    def noticed() -> bool:
        other.write(askew)
        return "obeys somebody else" in body.trouble

    assert eventually(noticed)
    other.close()


def test_two_who_take_turns_are_noticed(body: BridgeBody, running: Running) -> None:
    other = BridgeBody(config_of(running.fake))
    other.connect()
    askew = hold(other)
    askew = MotorCommand(askew.position + 0.3, askew.stiffness, askew.damping, askew.mode)

    def noticed() -> bool:
        body.write(DAMP)
        time.sleep(0.01)
        other.write(askew)
        time.sleep(0.01)
        return "obeys somebody else" in body.trouble

    assert eventually(noticed)
    other.close()


def test_a_stuck_intruder_is_noticed(body: BridgeBody, running: Running) -> None:
    running.fake.faults.intruder = True
    assert eventually(lambda: "obeys somebody else" in body.trouble)


def test_a_bridge_that_counts_its_clients_is_believed(body: BridgeBody, running: Running) -> None:
    running.fake.faults.announce = True

    def noticed() -> bool:
        body.write(DAMP)
        return "1 other program(s)" in body.trouble

    assert eventually(noticed)
    running.fake.faults.announce = False
    assert eventually(lambda: not body.trouble)


def test_close_may_be_called_twice(body: BridgeBody) -> None:
    body.close()
    body.close()
