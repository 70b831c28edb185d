"""However a program with its own policy ends, the robot is damped."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from egovcp.spec import ACTION_DIM, STATE_DIM
from egovcp_deploy.live import external_policy
from egovcp_deploy.live.external_policy import ExternalPolicyRobot
from egovcp_deploy.live.hardware import RobotOptions
from egovcp_deploy.live.link import decode_operator_command, encode_observation
from egovcp_deploy.live.processes import stop_control
from egovcp_deploy.pilot.planner import ObservationMessage
from egovcp_deploy.pilot.states import OperatorCommand
from egovcp_deploy.robots.fake.bridge import FakeBridge
from egovcp_deploy.robots.wire import decode_command
from tests.support.robots.fake_g1 import eventually


class HangingControl:
    """A control process in RUN that only SIGKILL ends, its link, and its watchdog."""

    def __init__(self) -> None:
        self.process = self.link = self
        self.watchdog = SimpleNamespace(expected=lambda: False, join_if_ended=lambda: None)
        self.alive = True
        self.commands: list[OperatorCommand] = []
        self.ends: list[tuple[str, bool]] = []  # signal, whether the watchdog would damp
        self.left = False

    def check_alive(self) -> None:
        assert self.alive

    def is_alive(self) -> bool:
        return self.alive

    def join(self, timeout: float | None = None) -> None: ...

    def terminate(self) -> None:
        self.ends.append(("terminate", not self.watchdog.expected()))

    def kill(self) -> None:
        self.ends.append(("kill", not self.watchdog.expected()))
        self.alive = False

    def send(self, parts: Sequence[bytes]) -> bool:
        command = decode_operator_command(parts) if len(parts) == 1 else None
        self.commands += [command] if command is not None else []
        return True

    def receive(self, timeout_s: float = 0.0) -> Iterator[list[bytes]]:
        depth, state = np.zeros((48, 64), np.uint16), np.zeros(STATE_DIM, np.float32)
        sent = np.zeros(ACTION_DIM)
        yield encode_observation(ObservationMessage(0, 1, depth, state, sent, True, "run"))

    @contextmanager
    def running(self, options: RobotOptions) -> Iterator[HangingControl]:
        try:
            yield self
        finally:
            self.left = True
            stop_control(self, self.watchdog)


@pytest.fixture
def control(monkeypatch: pytest.MonkeyPatch) -> HangingControl:
    found = HangingControl()
    monkeypatch.setattr(external_policy, "running_control", found.running)
    return found


def test_the_watchdog_damps_after_a_control_process_that_hangs_at_close(
    control: HangingControl, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(external_policy, "EASE_S", 0.0)
    robot = ExternalPolicyRobot(RobotOptions())
    robot.connect()
    robot.close()
    assert control.commands[-1].quit
    assert control.ends == [("terminate", False), ("kill", True)]


def test_an_interrupt_of_close_ends_the_control_process(
    control: HangingControl, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    robot = ExternalPolicyRobot(RobotOptions())
    robot.connect()
    monkeypatch.setattr(external_policy.time, "sleep", interrupted)
    with pytest.raises(KeyboardInterrupt):
        robot.close()
    assert control.left
    assert not control.alive
    robot.close()


#: Connects to the robot at the ports in its arguments, and ends.
_SCRIPT = """
import sys
from egovcp_deploy.live.external_policy import ExternalPolicyRobot
from egovcp_deploy.live.hardware import CameraOptions, RobotOptions
from egovcp_deploy.live.operators import AutomaticOperator
from egovcp_deploy.pilot.states import Limits
from egovcp_deploy.robots.bridge import BridgeConfig
from egovcp_deploy.robots.zmq_camera import ZmqCameraConfig
state, command, camera = map(int, sys.argv[1:])
options = RobotOptions(
    controller="stance",
    bridge=BridgeConfig(state_port=state, command_port=command),
    camera=CameraOptions(server=ZmqCameraConfig(port=camera)),
    limits=Limits(5.0, 10.0, 5.0, 5.0, 10_000, stand_s=0.3),
)
robot = ExternalPolicyRobot(options, AutomaticOperator())
robot.connect()
"""


@pytest.mark.slow
def test_a_program_that_ends_without_close_damps_the_robot(fake: FakeBridge) -> None:
    received: list[bytes] = []
    fake.on_command = received.append
    ports = [fake.ports.state_port, fake.ports.command_port, fake.ports.camera_port]
    result = subprocess.run(
        [sys.executable, "-c", _SCRIPT, *map(str, ports)],
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr
    stiff = [bool(decode_command(message).motors.stiffness.any()) for message in received]
    assert any(stiff)
    assert eventually(lambda: not decode_command(received[-1]).motors.stiffness.any())
