"""The control loop with its inputs in one process: recorded reasons, several episodes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from ctypes import c_bool
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.log.mcap import McapSink
from egovcp.log.mcap_reader import read_recording
from egovcp.log.tick import RunInfo, Tick
from egovcp.plan import PolicyStep
from egovcp.rate import MonotonicClock
from egovcp.robot.controllers import make_controller
from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.live import LiveRobot, Phase
from egovcp.sim.scenario import Scenario
from egovcp_deploy.live.control import ControlLoop
from egovcp_deploy.live.control_process import ControlProcess, merged
from egovcp_deploy.live.hardware import CameraOptions, RobotOptions, open_hardware
from egovcp_deploy.live.link import Link
from egovcp_deploy.live.operators import AutomaticOperator, RemoteControlInput
from egovcp_deploy.live.planner_loop import PlannerLoop
from egovcp_deploy.mcap.cli import main as mcap
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.planner import InlinePlanner, PlannerRunner
from egovcp_deploy.pilot.states import Limits, OperatorCommand, OperatorRequest, State
from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from egovcp_deploy.robots.fake.command import EpisodeSequencer, FakeG1Config
from egovcp_deploy.robots.zmq_camera import ZmqCameraConfig
from tests.support.lockstep import LockstepClock
from tests.support.pipes import full_pipe
from tests.support.robots.fake_g1 import FakeG1Thread, bridge_config
from tests.support.robots.sim_low_level import SimLowLevelRobot

from .conftest import QUIET, TICK_NS, Reaching

#: A busy machine is no fault here.
PATIENT = Limits(5.0, 10.0, 5.0, 5.0, 100_000, stand_s=0.3)


def test_a_recording_says_why_the_robot_was_held_and_damped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "run.mcap"
    robot = LiveRobot(QUIET)
    robot.start(Scenario("ball", 0, 0))
    fake = FakeBridge(robot, Ports(command_port=0, state_port=0, camera_port=0))
    running = FakeG1Thread(fake)
    try:
        drive(fake, file, tmp_path)
    finally:
        running.stop()
        fake.close()
    assert mcap(["info", str(file), "--json=-"]) == 0
    report = json.loads(capsys.readouterr().out)
    states = [(change["before"], change["after"]) for change in report["states"]]
    assert states[:3] == [("init", "stand"), ("stand", "armed"), ("armed", "run")]
    held, damped = report["states"][-2:]
    assert (held["after"], damped["after"]) == ("hold", "damp")
    assert "left_ankle_roll_joint is too hot: 80 deg C; let the robot down" in held["reason"]
    assert "motor of left_knee_joint does not" in damped["reason"]
    assert report["last_event"] == "end of the run: the motors are damped"
    hottest = report["joint_maxima"]["left_ankle_roll_joint"]
    assert hottest["temperature_deg_c"] == pytest.approx(80.0)
    ticks = read_recording(file).ticks
    assert {"mode_machine", "state_lost", "state_jitter_ms", "image_age_ms"} <= ticks[
        -1
    ].link.keys()
    off = [event for tick in ticks for event in tick.events if "checks that are off" in event]
    assert len(off) == 1, "what LeRobot's bridge does not report is said once"


def drive(fake: FakeBridge, file: Path, folder: Path) -> None:
    """From INIT to RUN; then a motor overheats, and once the robot is held another drops out."""
    bridge = bridge_config(fake)
    camera = CameraOptions(server=ZmqCameraConfig(port=fake.ports.camera_port))
    address = f"ipc://{folder}/link"
    options = RobotOptions(controller="stance", bridge=bridge, camera=camera, limits=PATIENT)
    ours, theirs = Link(address, serve=True), Link(address, serve=False)
    stopping: list[int] = []
    with closing(open_hardware(bridge, camera)) as hardware, closing(ours), closing(theirs):
        control = ControlProcess(options, os.getppid(), hardware, theirs, c_bool())
        thread = threading.Thread(target=control.run, args=(stopping,))
        thread.start()
        sink = McapSink(file)
        sink.open(RunInfo("ball", seed=0, episode=0))

        def break_motors(tick: Tick) -> None:
            if tick.mode == State.RUN:
                fake.faults.apply("hot_motor left_ankle_roll 125")
            if tick.mode == State.HOLD:
                fake.faults.apply("dropped_motor left_knee")

        operator = AutomaticOperator()
        loop = PlannerLoop(
            PlannerRunner(Reaching(0.0)), ours, operator, sink, MonotonicClock(), thread.is_alive
        )
        try:
            loop.run(break_motors)
        finally:
            stopping.append(signal.SIGTERM)
            thread.join()
            sink.close()


@pytest.mark.parametrize(
    ("requests", "expected"),
    [
        ("arm run", "run"),
        ("hold run", "hold"),
        ("run hold", "hold"),
        ("estop hold run", "estop"),
        ("hold estop", "estop"),
        ("", None),
    ],
)
def test_a_stop_precedes_a_hold_which_precedes_other_requests(
    requests: str, expected: str | None
) -> None:
    commands = [OperatorCommand(OperatorRequest(request)) for request in requests.split()]
    velocities = [(0.1, 0.0, 0.0), (0.2, 0.0, 0.0)]
    commands += [OperatorCommand(velocity=velocity) for velocity in velocities]
    assert merged(commands) == OperatorCommand(expected, velocities[-1])


def test_a_blocked_terminal_does_not_stop_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = full_pipe()
    hardware = SimpleNamespace(body=SimpleNamespace(read=lambda: None), camera=None, link=None)
    options, parent = RobotOptions(controller="stance"), 0  # has ended
    ticks, stopping, enough = list[int](), list[int](), threading.Event()

    def tick(now_ns: int, command: OperatorCommand) -> None:
        ticks.append(now_ns)
        if len(ticks) > 5:
            enough.set()

    pilot = SimpleNamespace(add_events=lambda events: None)
    with open(writer, "w") as full, closing(Link(f"ipc://{tmp_path}/link", serve=True)) as link:
        control = ControlProcess(options, parent, hardware, link, c_bool())
        control._loop = SimpleNamespace(state=State.RUN, tick=tick, pilot=pilot, commanding=True)
        monkeypatch.setattr(sys, "stderr", full)
        thread = threading.Thread(target=control.run, args=(stopping,))
        thread.start()
        try:
            assert enough.wait(30.0)
        finally:
            os.close(reader)  # ends a blocked write
            stopping.append(signal.SIGTERM)
            thread.join()


#: `control_process` without a robot; its loop sends a signal to itself. If the second argument is
#: 1, it has commanded the motors.
_STUBBED = """
import ctypes, os, sys, time
from types import SimpleNamespace as Stub
from egovcp_deploy.live import control_process as c
hardware = Stub(body=None, close=lambda: None)
def run(stopping):
    os.kill(os.getpid(), int(sys.argv[1]))
    while not stopping:
        time.sleep(0.01)
c.open_hardware = lambda bridge, camera: hardware
c.Link = lambda address, serve: Stub(close=lambda: None)
c.raise_priority = lambda level: False
c.ControlProcess = lambda *arguments: Stub(run=run, add_event=lambda event: print(event))
c.damp_motors = lambda body: print("damped")
c.control_process(Stub(bridge=None, camera=None), "", 0, ctypes.c_bool(int(sys.argv[2])))
"""


@pytest.mark.parametrize(
    ("number", "commanded"),
    [(signal.SIGTERM, 1), (signal.SIGHUP, 1), (signal.SIGQUIT, 1), (signal.SIGTERM, 0)],
)
def test_a_signal_damps_the_motors_if_they_were_commanded(
    number: signal.Signals, commanded: int
) -> None:
    result = subprocess.run(
        [sys.executable, "-c", _STUBBED, str(int(number)), str(commanded)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    warning, *end = result.stdout.splitlines()
    assert "no real-time priority" in warning
    assert end == ["damped"] * commanded


def test_it_tells_the_watchdog_that_it_has_commanded(tmp_path: Path) -> None:
    hardware = SimpleNamespace(body=SimpleNamespace(read=lambda: None), camera=None, link=None)
    stopping, seen, commanded = list[int](), list[bool](), c_bool()

    def tick(now_ns: int, command: OperatorCommand) -> None:
        seen.append(commanded.value)
        loop.commanding = len(seen) > 1
        if len(seen) == 3:
            stopping.append(signal.SIGTERM)

    loop = SimpleNamespace(state=State.INIT, tick=tick, commanding=False)
    with closing(Link(f"ipc://{tmp_path}/link", serve=True)) as link:
        options = RobotOptions(controller="stance")
        control = ControlProcess(options, os.getppid(), hardware, link, commanded)
        control._loop = loop
        control.run(stopping)
    assert seen == [False, False, True]


class Crouching(Reaching):
    """Wants the pelvis as low as it goes."""

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        step = super().act(depth, state, remaining)
        step.plan[..., -1] = -1.0
        return step


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stance", "walk"])
@pytest.mark.parametrize("pause", [1.5, 2.0])
def test_the_robot_stands_in_each_of_several_episodes(name: str, pause: float) -> None:
    quiet = EpisodeConfig(ticks=50, event_ticks=(5, 5), empty_probability=1.0)
    robot = LiveRobot(EnvConfig(controller=name, ball_episode=quiet))
    robot.start(Scenario("ball", 0, 0))
    body = SimLowLevelRobot(robot)
    config = FakeG1Config(pause=pause)
    episodes = EpisodeSequencer(body, config, (Scenario("ball", 0, n) for n in range(3)))
    clock, controller = LockstepClock(), make_controller(name)
    planner = InlinePlanner(PlannerRunner(Crouching()))
    loop = ControlLoop(body, body.camera, controller, Pilot(planner, Limits()))
    operator, remote = AutomaticOperator(), RemoteControlInput()
    seen: set[tuple[Phase, State]] = set()
    for _ in range(2500):
        commands = [
            *operator.commands(clock.now_ns(), loop.state),
            *remote.commands(body.read().remote),
        ]
        loop.tick(clock.now_ns(), OperatorCommand(merged(commands).request))
        seen.add((robot.phase, loop.state))
        for _ in range(4):
            episodes.step()
        clock.advance(TICK_NS)
        if episodes.finished:
            break
    assert [outcome.fallen for outcome in episodes.outcomes] == [False] * 3
    assert State.DAMP not in {state for _, state in seen}
    assert {state for phase, state in seen if phase is Phase.EPISODE} == {State.RUN}
