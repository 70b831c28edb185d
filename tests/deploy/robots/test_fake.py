"""The fake G1, driven by a controller over the bridge."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
import zmq

from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.robot.controllers import make_controller
from egovcp.robot.g1 import DAMPING, STIFFNESS
from egovcp.sim.live import LiveRobot, Phase
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_BOX, JOINT_NAMES
from egovcp_deploy.robots.base import MotorCommand, proprioception
from egovcp_deploy.robots.bridge import BridgeRobot
from egovcp_deploy.robots.fake.bridge import MODE, WATCHDOG_S, FakeBridge, Ports
from egovcp_deploy.robots.fake.command import EpisodeSequencer, FakeG1Config, outcome_text
from egovcp_deploy.robots.fake.faults import InjectedFaults
from egovcp_deploy.robots.wire import encode_command
from egovcp_deploy.robots.zmq_camera import decode_frame
from tests.support.robots.fake_g1 import FakeG1Thread, eventually

NEUTRAL = np.concatenate([np.zeros(3), ACTION_BOX.neutral])


class LockstepDriver:
    """Steps a fake G1 and a controller in turn, over real sockets."""

    def __init__(self, fake: FakeBridge, robot: BridgeRobot) -> None:
        self.fake, self.robot = fake, robot
        self.received: list[bytes] = []
        fake.on_command = self.received.append
        self.controller = make_controller("stance")
        self.controller.reset(self._state()[None])

    def _state(self) -> np.ndarray:
        state = self.robot.read()
        assert state is not None
        return proprioception(state, NEUTRAL)

    def tick(self, episodes: EpisodeSequencer) -> None:
        """Advance by 20 ms, then send the controller's command for the newest state."""
        for _ in range(4):
            seen = self.robot.read()
            self._send_until(
                episodes.step, lambda last=seen: episodes.finished or self.robot.read() is not last
            )
        target = self.controller.step(self._state()[None])[0]
        received = len(self.received)
        command = MotorCommand(target, STIFFNESS, DAMPING, MODE)
        self._send_until(lambda: self.robot.write(command), lambda: self._received(received))

    def _send_until(self, send: Callable[[], object], arrived: Callable[[], bool]) -> None:
        """Send until it arrives: a reader that joins anew, as after a second of silence on a busy
        machine, never sees what was published meanwhile."""
        for _ in range(20):
            send()
            if eventually(arrived, timeout=5.0):
                return
        raise AssertionError("twenty messages, and none arrived")

    def _received(self, before: int) -> bool:
        self.fake._receive()
        return len(self.received) > before


@pytest.fixture
def driver(running: FakeG1Thread, robot: BridgeRobot) -> LockstepDriver:
    running.stop()
    return LockstepDriver(running.fake, robot)


def test_a_controller_plays_all_episodes_over_the_bridge(driver: LockstepDriver) -> None:
    log: list[str] = []
    scenarios = [Scenario("ball", 1, 0), Scenario("wall", 1, 1)]
    episodes = EpisodeSequencer(
        driver.fake,
        FakeG1Config(gantry=0.5, settle=0.5, pause=1.5),
        iter(scenarios),
        log.append,
    )
    heights = []
    while not episodes.finished:
        driver.tick(episodes)
        if driver.fake.robot.phase is not Phase.OVER:
            heights.append(driver.fake.robot.robot.pelvis_height)
        assert "does not follow" not in driver.robot.refusal
    assert [outcome.scenario for outcome in episodes.outcomes] == scenarios
    assert [outcome.ticks for outcome in episodes.outcomes] == [20, 20]
    assert not episodes.outcomes[0].fallen
    assert min(heights) > 0.6
    assert log[:3] == [
        "episode 0 (ball): on the gantry",
        "the gantry releases the robot",
        "the task begins",
    ]
    assert log[3] == outcome_text(episodes.outcomes[0])


def test_the_gantry_waits_for_commands_with_stiffness(fake: FakeBridge) -> None:
    episodes = EpisodeSequencer(fake, FakeG1Config(gantry=0.0), iter([Scenario("ball", 0, 0)]))
    for _ in range(100):
        episodes.step()
    assert fake.robot.phase is Phase.HELD
    send(fake, MotorCommand(np.zeros(29), np.zeros(29), DAMPING, MODE))
    episodes.step()
    assert fake.robot.phase is Phase.HELD, "damping holds nothing"
    send(fake, MotorCommand(np.zeros(29), STIFFNESS, DAMPING, MODE))
    episodes.step()
    episodes.step()
    assert fake.robot.phase is Phase.FREE


def test_the_gantry_waits_for_release_without_a_schedule(fake: FakeBridge) -> None:
    episodes = EpisodeSequencer(fake, FakeG1Config(gantry=None), iter([Scenario("ball", 0, 0)]))
    send(fake, MotorCommand(np.zeros(29), STIFFNESS, DAMPING, MODE))
    for _ in range(20):
        episodes.step()
    assert fake.robot.phase is Phase.HELD
    fake.faults.apply("")
    episodes.step()
    assert fake.robot.phase is Phase.FREE


def send(fake: FakeBridge, command: MotorCommand) -> None:
    """As any client would, and wait until the fake has received it."""
    send_raw(fake, encode_command(command))


def send_raw(fake: FakeBridge, payload: bytes) -> None:
    messages: list[bytes] = []
    fake.on_command = messages.append
    with zmq.Context() as context, context.socket(zmq.PUSH) as client:
        client.connect(f"tcp://{fake.ports.host}:{fake.ports.command_port}")
        client.send(payload)

        def received() -> bool:
            fake._receive()
            return bool(messages)

        assert eventually(received)


def test_without_commands_the_motors_damp(fake: FakeBridge) -> None:
    send(fake, MotorCommand(np.zeros(29), STIFFNESS, DAMPING, MODE))
    fake.step()
    assert fake.commanded
    for _ in range(round(WATCHDOG_S / 0.005) + 2):
        fake.step()
    assert not fake.commanded


def test_commands_for_another_mode_are_ignored(fake: FakeBridge) -> None:
    send(fake, MotorCommand(np.zeros(29), STIFFNESS, DAMPING, MODE + 1))
    assert not fake.commanded


def test_malformed_commands_are_ignored(fake: FakeBridge) -> None:
    send_raw(fake, b"hello")
    assert not fake.commanded


def test_commands_can_be_ignored_as_a_fault(robot: BridgeRobot, running: FakeG1Thread) -> None:
    running.fake.faults.ignore_commands = True
    received: list[bytes] = []
    running.fake.on_command = received.append

    def arrived() -> bool:
        robot.write(MotorCommand(np.zeros(29), STIFFNESS, DAMPING, MODE))
        return len(received) > 3

    assert eventually(arrived)
    assert not running.fake.commanded


def test_a_push_makes_the_robot_fall(driver: LockstepDriver) -> None:
    config = FakeG1Config(gantry=0.2, settle=100.0)
    episodes = EpisodeSequencer(driver.fake, config, iter([Scenario("ball", 2, 0)]))
    while driver.fake.robot.phase is Phase.HELD:
        driver.tick(episodes)
    driver.fake.faults.apply("push")
    for _ in range(75):
        driver.tick(episodes)
    assert [outcome.fallen for outcome in episodes.outcomes] == [True]


def test_dropped_messages_do_not_arrive(robot: BridgeRobot, running: FakeG1Thread) -> None:
    running.fake.faults.drop = 1.0
    time.sleep(0.1)
    last = robot.read()
    time.sleep(0.1)
    assert robot.read() is last
    running.fake.faults.drop = 0.5
    assert eventually(lambda: robot.read() is not last)


@pytest.fixture
def viewer(fake: FakeBridge) -> zmq.Socket[bytes]:
    context = zmq.Context()
    end = context.socket(zmq.SUB)
    end.setsockopt(zmq.SUBSCRIBE, b"")
    end.connect(f"tcp://{fake.ports.host}:{fake.ports.camera_port}")
    yield end
    context.destroy(linger=0)


def test_images_are_numbered_and_repeat_when_frozen(
    viewer: zmq.Socket[bytes], running: FakeG1Thread
) -> None:
    first = decode_frame(viewer.recv())
    second = decode_frame(viewer.recv())
    assert second.sequence == first.sequence + 1
    assert first.depth.any()
    assert first.vertical_fov == pytest.approx(running.fake.robot.config.camera.vertical_fov)
    running.fake.faults.freeze_camera = True
    repeated = [decode_frame(viewer.recv()).sequence for _ in range(4)]
    assert repeated[-1] == repeated[-2]


def test_a_used_port_is_refused(fake: FakeBridge, live: LiveRobot) -> None:
    taken = Ports(command_port=fake.ports.command_port, state_port=0, camera_port=0)
    with pytest.raises(EnvironmentFailure, match="another egovcp-fake-g1"):
        FakeBridge(live, taken)


def test_console_commands_set_and_clear_faults() -> None:
    faults = InjectedFaults()
    for line in ("freeze_state", "drop 0.25", "mode 3", "push 1 -0.5"):
        faults.apply(line)
    assert faults == InjectedFaults(freeze_state=True, drop=0.25, mode=3, push=(1.0, -0.5))
    assert "drop" not in faults.apply("drop off")
    faults.apply("hot_motor left_knee 110")
    assert faults.hot_motor == (JOINT_NAMES.index("left_knee_joint"), 110.0)
    faults.apply("freeze_state off")
    assert not faults.freeze_state
    assert faults.apply("clear") == "faults: none"
    assert faults == InjectedFaults()


@pytest.mark.parametrize(
    "line",
    [
        *("frieze_state", "drop", "drop much", "push hard", "push 1", "drop nan", "mode 300"),
        "mode 6.5",
        *("freeze_camera of", "clear all", "release now", "dropped_motor left_knee 3"),
        *("hot_motor left_knee 110 120", "hot_motor left_knee nan", "push nan 0", "push inf 0"),
    ],
)
def test_unknown_console_commands_are_refused(line: str) -> None:
    faults = InjectedFaults()
    with pytest.raises(UsageError):
        faults.apply(line)
    assert faults == InjectedFaults()
