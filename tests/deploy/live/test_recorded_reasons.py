"""A recording of a faulted run before the fake robot says why it was held and damped.

Control loop and planner run in threads of one process, the robot behind real sockets.
"""

from __future__ import annotations

import json
import os
import threading
from contextlib import closing
from pathlib import Path

import pytest

from egovcp.log.mcap import McapSink
from egovcp.log.mcap_reader import read_recording
from egovcp.log.tick import RunInfo, Tick
from egovcp.rate import MonotonicClock
from egovcp.sim.live import LiveRobot
from egovcp.sim.scenario import Scenario
from egovcp_deploy.live.hardware import CameraOptions, HardwareOptions, open_hardware
from egovcp_deploy.live.link import Link
from egovcp_deploy.live.operators import Auto
from egovcp_deploy.live.planner import PlannerLoop
from egovcp_deploy.live.process import ControlProcess, ControlSetup, Flag
from egovcp_deploy.mcap.cli import main as mcap
from egovcp_deploy.pilot.desk import Thinker
from egovcp_deploy.pilot.states import Limits, State
from egovcp_deploy.robots.fake import FakeBridge, Ports
from egovcp_deploy.robots.zmq_camera import ZmqCameraConfig
from tests.support.robots.fake_g1 import FakeG1Thread, bridge_config

from .conftest import QUIET, Reaching

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
    options = HardwareOptions(
        bridge_config(fake), CameraOptions(server=ZmqCameraConfig(port=fake.ports.camera_port))
    )
    address = f"ipc://{folder}/link"
    setup = ControlSetup(address, options, "stance", PATIENT, os.getppid())
    ours, theirs = Link(address, serve=True), Link(address, serve=False)
    quitting = Flag()
    with closing(open_hardware(options)) as hardware, closing(ours), closing(theirs):
        control = ControlProcess(setup, hardware, theirs)
        thread = threading.Thread(target=control.run, args=(quitting,))
        thread.start()
        sink = McapSink(file)
        sink.open(RunInfo("ball", seed=0, episode=0))

        def break_motors(tick: Tick) -> None:
            if tick.mode == State.RUN:
                fake.faults.apply("hot_motor left_ankle_roll 125")
            if tick.mode == State.HOLD:
                fake.faults.apply("dropped_motor left_knee")

        operator = Auto((0.0, 0.0, 0.0), 0.0)
        loop = PlannerLoop(
            Thinker(Reaching(0.0)), ours, operator, sink, MonotonicClock(), thread.is_alive
        )
        try:
            loop.run(break_motors)
        finally:
            quitting.set()
            thread.join()
            sink.close()
