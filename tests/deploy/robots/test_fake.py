"""The fake robot: a controller on the other side of the wire carries it through its episodes."""

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
from egovcp.spec import ACTION_BOX
from egovcp_deploy.robots.body import MotorCommand
from egovcp_deploy.robots.bridge import BridgeBody
from egovcp_deploy.robots.depth_wire import decode_picture
from egovcp_deploy.robots.fake import FakeBridge, Faults, Ports
from egovcp_deploy.robots.fake.bridge import MODE, WATCHDOG_S
from egovcp_deploy.robots.fake.running import PATIENCE_S, Running, config_of, eventually
from egovcp_deploy.robots.fake.stage import Schedule, Stage, spoken
from egovcp_deploy.robots.proprioception import proprioception
from egovcp_deploy.robots.wire import encode_command

NEUTRAL = np.concatenate([np.zeros(3), ACTION_BOX.neutral])


class Puppeteer:
    """A fake and a controller in lock-step, over real sockets."""

    def __init__(self, fake: FakeBridge, body: BridgeBody) -> None:
        self.fake, self.body = fake, body
        self.controller = make_controller("stance")
        self.controller.reset(self._state()[None])

    def _state(self) -> np.ndarray:
        body = self.body.read()
        assert body is not None
        return proprioception(body, NEUTRAL)

    def tick(self, stage: Stage) -> None:
        """20 ms of the robot's life, after which the controller answers to its newest state."""
        for _ in range(4):
            seen = self.body.traffic.readings
            self._insist(
                stage.step, lambda n=seen: stage.finished or self.body.traffic.readings > n
            )
        target = self.controller.step(self._state()[None])[0]
        c, heard = self.controller, self.fake.counts.commands
        command = MotorCommand(target, c.stiffness, c.damping, MODE)
        self._insist(lambda: self.body.write(command), lambda: self._heard(heard))

    def _insist(self, send: Callable[[], object], arrived: Callable[[], bool]) -> None:
        """Send until it arrives: a reader that joins anew, as after a second of silence on a busy
        machine, never sees what was published meanwhile."""
        for _ in range(20):
            send()
            if eventually(arrived, patience=5.0):
                return
        raise AssertionError("twenty messages, and none arrived")

    def _heard(self, before: int) -> bool:
        self.fake._listen()
        return self.fake.counts.commands > before


@pytest.fixture
def puppeteer(running: Running, body: BridgeBody) -> Puppeteer:
    running.stop()
    return Puppeteer(running.fake, body)


def test_a_controller_behind_the_wire_carries_it_through_its_episodes(puppeteer: Puppeteer) -> None:
    said: list[str] = []
    scenarios = [Scenario("ball", 1, 0), Scenario("wall", 1, 1)]
    stage = Stage(
        puppeteer.fake,
        lambda n: scenarios[n] if n < 2 else None,
        Schedule(gantry=0.5, settle=0.5, pause=0.1),
        said.append,
    )
    heights = []
    while not stage.finished:
        puppeteer.tick(stage)
        if not puppeteer.fake.over:
            heights.append(puppeteer.fake.robot.robot.pelvis_height)
        assert "obeys" not in puppeteer.body.trouble
    assert [outcome.scenario for outcome in stage.outcomes] == scenarios
    assert [outcome.ticks for outcome in stage.outcomes] == [20, 20]
    assert not stage.outcomes[0].fallen
    assert min(heights) > 0.6
    assert said[:3] == ["episode 0 (ball): on the crane", "the crane lets go", "the task begins"]
    assert said[3] == spoken(stage.outcomes[0])


def test_the_crane_waits_for_commands_that_hold(fake: FakeBridge) -> None:
    stage = Stage(fake, lambda n: Scenario("ball", 0, 0), Schedule(gantry=0.0))
    for _ in range(100):
        stage.step()
    assert fake.robot.phase is Phase.HELD
    send(fake, MotorCommand(np.zeros(29), np.zeros(29), DAMPING, MODE))
    stage.step()
    assert fake.robot.phase is Phase.HELD, "damping holds nothing"
    send(fake, MotorCommand(np.zeros(29), STIFFNESS, DAMPING, MODE))
    stage.step()
    stage.step()
    assert fake.robot.phase is Phase.FREE


def test_the_crane_may_wait_to_be_told(fake: FakeBridge) -> None:
    stage = Stage(fake, lambda n: Scenario("ball", 0, 0), Schedule(gantry=None))
    send(fake, MotorCommand(np.zeros(29), STIFFNESS, DAMPING, MODE))
    for _ in range(20):
        stage.step()
    assert fake.robot.phase is Phase.HELD
    fake.faults.obey("")
    stage.step()
    assert fake.robot.phase is Phase.FREE


def send(fake: FakeBridge, command: MotorCommand) -> None:
    """As any client would, and wait until the fake has heard it."""
    send_raw(fake, encode_command(command))


def send_raw(fake: FakeBridge, payload: bytes) -> None:
    counts = fake.counts
    before = (counts.commands, counts.garbled, counts.ignored)
    with zmq.Context() as context, context.socket(zmq.PUSH) as client:
        client.connect(f"tcp://{fake.ports.host}:{fake.ports.command_port}")
        client.send(payload)

        def heard() -> bool:
            fake._listen()
            return (counts.commands, counts.garbled, counts.ignored) != before

        assert eventually(heard)


def test_without_commands_the_motors_damp(fake: FakeBridge) -> None:
    send(fake, MotorCommand(np.zeros(29), STIFFNESS, DAMPING, MODE))
    fake.step()
    assert fake.commanded
    for _ in range(round(WATCHDOG_S / 0.005) + 2):
        fake.step()
    assert not fake.commanded


def test_commands_for_another_mode_are_ignored(fake: FakeBridge) -> None:
    send(fake, MotorCommand(np.zeros(29), STIFFNESS, DAMPING, MODE + 1))
    assert (fake.counts.ignored, fake.counts.commands) == (1, 0)
    assert not fake.commanded


def test_nonsense_is_counted(fake: FakeBridge) -> None:
    send_raw(fake, b"hello")
    assert (fake.counts.garbled, fake.counts.commands) == (1, 0)


def test_a_deaf_robot_hears_nothing(body: BridgeBody, running: Running) -> None:
    running.fake.faults.deaf = True
    for _ in range(20):
        body.write(MotorCommand(np.zeros(29), STIFFNESS, DAMPING, MODE))
        time.sleep(0.005)
    assert running.fake.counts.commands == 0


def test_a_push_knocks_it_over(puppeteer: Puppeteer) -> None:
    stage = Stage(
        puppeteer.fake, lambda n: Scenario("ball", 2, n), Schedule(gantry=0.2, settle=100.0)
    )
    while puppeteer.fake.robot.phase is Phase.HELD:
        puppeteer.tick(stage)
    puppeteer.fake.faults.obey("push")
    for _ in range(75):
        puppeteer.tick(stage)
    assert [outcome.fallen for outcome in stage.outcomes] == [True]


def test_lost_messages_are_lost(body: BridgeBody, running: Running) -> None:
    running.fake.faults.drop = 1.0
    time.sleep(0.1)
    last = body.read()
    time.sleep(0.1)
    assert body.read() is last
    running.fake.faults.drop = 0.5
    assert eventually(lambda: body.read() is not last)


@pytest.fixture
def viewer(fake: FakeBridge) -> zmq.Socket[bytes]:
    context = zmq.Context()
    end = context.socket(zmq.SUB)
    end.setsockopt(zmq.SUBSCRIBE, b"")
    end.connect(f"tcp://{fake.ports.host}:{fake.ports.camera_port}")
    yield end
    context.destroy(linger=0)


def test_pictures_come_at_the_cameras_rate(viewer: zmq.Socket[bytes], running: Running) -> None:
    first = decode_picture(viewer.recv())
    second = decode_picture(viewer.recv())
    assert second.sequence == first.sequence + 1
    assert first.depth.any()
    assert first.vertical_fov == pytest.approx(running.fake.robot.config.camera.vertical_fov)
    running.fake.faults.freeze_camera = True
    repeated = [decode_picture(viewer.recv()).sequence for _ in range(4)]
    assert repeated[-1] == repeated[-2]


def test_one_port_is_not_for_two(fake: FakeBridge, live: LiveRobot) -> None:
    taken = Ports(command_port=fake.ports.command_port, state_port=0, camera_port=0)
    with pytest.raises(EnvironmentFailure, match="another egovcp-fake-g1"):
        FakeBridge(live, taken)


def test_it_counts_the_programs_that_send(live: LiveRobot) -> None:
    live.start(Scenario("ball", 0, 0))
    ports = Ports(command_port=0, state_port=0, camera_port=0)
    fake = FakeBridge(live, ports, announce=True)
    running = Running(fake)
    one, two = BridgeBody(config_of(fake)), BridgeBody(config_of(fake))
    try:
        for body in (one, two):
            body.connect(PATIENCE_S)
        damp = MotorCommand(np.zeros(29), np.zeros(29), DAMPING, MODE)

        def noticed() -> bool:
            one.write(damp)
            two.write(damp)
            return "1 other program(s)" in one.trouble

        assert eventually(noticed)
    finally:
        for part in (one, two, running, fake):
            part.stop() if isinstance(part, Running) else part.close()


def test_words_set_faults_and_heal_them() -> None:
    faults = Faults()
    for line in ("freeze_state", "drop 0.25", "mode 3", "push 1 -0.5"):
        faults.obey(line)
    assert faults == Faults(freeze_state=True, drop=0.25, mode=3, push=(1.0, -0.5))
    for line in ("gyroscope 150", "joint_speed -25", "flood 20"):
        faults.obey(line)
    assert (faults.gyroscope, faults.joint_speed, faults.flood) == (150.0, -25.0, 20)
    assert "flood" not in faults.obey("flood off")
    faults.obey("freeze_state off")
    assert not faults.freeze_state
    assert faults.obey("heal") == "faults: none"
    assert faults == Faults()


@pytest.mark.parametrize(
    "line", ["frieze_state", "drop", "drop much", "push hard", "push 1", "flood nan"]
)
def test_words_that_mean_nothing_are_refused(line: str) -> None:
    faults = Faults()
    with pytest.raises(UsageError):
        faults.obey(line)
    assert faults == Faults()
