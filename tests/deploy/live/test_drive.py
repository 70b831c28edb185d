"""`egovcp-deploy` on the wall clock: processes are killed and interrupted.

Reaction times are tested in `tests/deploy/test_faults.py` and `test_control.py`, whose time does
not depend on the machine; here only whether the reactions occur.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from egovcp.errors import DataError
from egovcp.log.mcap_reader import read_recording
from egovcp.sim.live import LiveRobot
from egovcp.sim.scenario import Scenario
from egovcp_deploy.pilot.states import State
from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from tests.support.robots.fake_g1 import FakeG1Thread, eventually, fake_g1_process

from .conftest import PATIENT, QUICK

_PROGRAM = """
import signal, sys
from egovcp_deploy.commands import deploy
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # also under nohup
sys.exit(deploy())
"""
#: The planner raises once it has driven for a while.
_FAILING = """
from egovcp_deploy.pilot import planner
plan = planner.PlannerRunner.plan
running = 0
def failing(self, observations, remaining=None):
    global running
    running += observations[-1].mode == "run"
    if running > 5:
        raise ZeroDivisionError("a mistake")
    return plan(self, observations, remaining)
planner.PlannerRunner.plan = failing
"""


@dataclass
class Stand:
    """A fake robot whose time passes, and a program that drives it."""

    fake: FakeBridge
    program: subprocess.Popen[str]
    folder: Path

    @property
    def holds(self) -> bool:
        """Whether its motors have stiffness."""
        return bool(self.fake.robot.robot.model.actuator_biasprm[:, 1].any())

    @property
    def control(self) -> psutil.Process:
        """The control process."""
        children = psutil.Process(self.program.pid).children()
        (found,) = [c for c in children if "spawn_main" in " ".join(c.cmdline())]
        return found

    def await_run(self) -> None:
        def over() -> bool:
            return State.RUN in self.modes() or self.program.poll() is not None

        assert eventually(over)
        assert self.program.poll() is None, self.end()

    def modes(self) -> list[str]:
        """Of the ticks that are in the recording by now."""
        try:
            recording = read_recording(self.folder / "rollout-0.mcap")
        except DataError:  # nothing has been written yet
            return []
        return [tick.mode for tick in recording.ticks]

    def end(self) -> str:
        """Its last words."""
        return self.program.communicate(timeout=240)[1]


@pytest.fixture
def fake(robot: LiveRobot) -> Iterator[FakeBridge]:
    """Its time passes."""
    robot.start(Scenario("ball", 0, 0))
    found = FakeBridge(robot, Ports(command_port=0, state_port=0, camera_port=0))
    running = FakeG1Thread(found)
    yield found
    running.stop()
    found.close()


type Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start(artifact_dir: Path, tmp_path: Path) -> Iterator[Start]:
    """Starts a run of a tiny planner, recorded in ``tmp_path / "run"``."""
    programs = list[subprocess.Popen[str]]()

    def start(ports: Ports, *flags: str, before: str = "") -> subprocess.Popen[str]:
        command = [
            *(sys.executable, "-c", before + _PROGRAM, "--robot.type=unitree_g1"),
            *(f"--policy.path={artifact_dir}", f"--output_dir={tmp_path / 'run'}"),
            *("--robot.controller=stance", "--log.rrd=false", "--log.videos=0"),
            f"--robot.bridge.state_port={ports.state_port}",
            f"--robot.bridge.command_port={ports.command_port}",
            f"--robot.camera.server.port={ports.camera_port}",
            *QUICK,
            *PATIENT,
            *flags,
        ]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        program = subprocess.Popen(
            command, stderr=subprocess.PIPE, text=True, env=environment, start_new_session=True
        )
        programs.append(program)
        return program

    yield start
    for program in programs:
        with_children = [psutil.Process(program.pid)] if program.poll() is None else []
        for process in [c for p in with_children for c in (*p.children(recursive=True), p)]:
            process.kill()
        program.wait()


@pytest.fixture
def drive(fake: FakeBridge, start: Start, tmp_path: Path) -> Callable[..., Stand]:
    def drive(*flags: str, before: str = "") -> Stand:
        return Stand(fake, start(fake.ports, *flags, before=before), tmp_path / "run")

    return drive


@pytest.mark.slow
def test_a_run_stands_up_runs_holds_and_leaves_the_motors_damped(
    drive: Callable[..., Stand],
) -> None:
    stand = drive("--operator.duration=1", "--log.videos=1")
    words = stand.end()
    assert stand.program.returncode == 0, words
    modes = stand.modes()
    order = [State.INIT, State.STAND, State.ARMED, State.RUN, State.HOLD]
    assert list(dict.fromkeys(modes)) == order
    assert not stand.holds
    report = json.loads((stand.folder / "deploy.json").read_text())
    assert report["ticks_running"] == pytest.approx(modes.count(State.RUN), abs=1)
    assert report["damped"] == ""
    assert report["missing_ticks"] == {"rollout-0.mcap": 0, "rollout-0.gif": 0}


def test_killing_the_control_process_damps_the_robot_and_ends_with_a_safety_stop(
    drive: Callable[..., Stand],
) -> None:
    stand = drive()
    stand.await_run()
    assert stand.holds
    stand.control.kill()
    assert eventually(lambda: not stand.holds)
    words = stand.end()
    assert stand.program.returncode == 6, words
    assert "the control process died" in words
    recording = read_recording(stand.folder / "rollout-0.mcap")
    assert recording.complete
    assert recording.ticks[-1].events[-1] == "end of the run: the control process is gone"


def kill(program: subprocess.Popen[str]) -> None:
    program.kill()


def hang_up(program: subprocess.Popen[str]) -> None:
    """What closing its terminal does."""
    os.killpg(program.pid, signal.SIGHUP)


@pytest.mark.slow
@pytest.mark.parametrize("end", [kill, hang_up])
def test_killing_the_planner_leaves_the_robot_standing_until_sigterm(
    drive: Callable[..., Stand], end: Callable[[subprocess.Popen[str]], None]
) -> None:
    stand = drive()
    stand.await_run()
    control = stand.control
    others = psutil.Process(stand.program.pid).children(recursive=True)
    commands = {p.pid: " ".join(p.cmdline()) for p in others}
    end(stand.program)
    stand.program.wait()
    received: list[bytes] = []
    stand.fake.on_command = received.append
    assert eventually(lambda: len(received) > 50)
    assert stand.holds
    needed = {control.pid, *(p.pid for p in others if "resource_tracker" in commands[p.pid])}
    assert not psutil.wait_procs([p for p in others if p.pid not in needed], timeout=60)[1]
    control.terminate()
    assert eventually(lambda: not control.is_running() or control.status() == "zombie")
    assert not stand.holds
    assert f"damped: by kill {control.pid}" in stand.end()
    assert not psutil.wait_procs(others, timeout=60)[1]
    recording = read_recording(stand.folder / "rollout-0.mcap")
    assert State.RUN in [tick.mode for tick in recording.ticks]


@pytest.mark.slow
def test_a_planner_exception_leaves_the_robot_standing_until_the_second_interrupt(
    drive: Callable[..., Stand],
) -> None:
    stand = drive(before=_FAILING)
    assert eventually(lambda: stand.modes()[-1:] == [State.HOLD])
    ticks = len(stand.modes())
    stand.program.send_signal(signal.SIGINT)
    assert eventually(lambda: len(stand.modes()) > ticks + 25)
    assert stand.modes()[-1] == State.HOLD
    assert stand.holds
    stand.program.send_signal(signal.SIGINT)
    assert eventually(lambda: not stand.holds)
    words = stand.end()
    assert stand.program.returncode == 6, words
    assert "the planner failed: ZeroDivisionError: a mistake" in words
    assert "Traceback" not in words
    report = json.loads((stand.folder / "deploy.json").read_text())
    assert report["failure"] == "ZeroDivisionError: a mistake"


def test_the_first_interrupt_holds_the_second_damps(drive: Callable[..., Stand]) -> None:
    stand = drive()
    stand.await_run()
    stand.program.send_signal(signal.SIGINT)
    assert eventually(lambda: stand.modes()[-1] == State.HOLD)
    assert stand.holds
    stand.program.send_signal(signal.SIGINT)
    assert eventually(lambda: not stand.holds)
    words = stand.end()
    assert stand.program.returncode == 6, words
    assert "emergency stop" in words


@pytest.mark.slow
def test_a_robot_that_goes_silent_is_damped_and_the_run_is_a_safety_stop(
    drive: Callable[..., Stand],
) -> None:
    stand = drive("--robot.limits.state_damp_s=3", "--robot.limits.state_hold_s=2")
    stand.await_run()
    stand.fake.faults.freeze_state = True
    assert eventually(lambda: not stand.holds)
    words = stand.end()
    assert stand.program.returncode == 6, words
    assert "no new proprioception" in words


@pytest.mark.slow
def test_a_missing_robot_is_reported_at_once(artifact_dir: Path, tmp_path: Path) -> None:
    result = subprocess.run(
        [
            *(sys.executable, "-c", _PROGRAM, "--robot.type=unitree_g1"),
            *(f"--policy.path={artifact_dir}", f"--output_dir={tmp_path / 'run'}"),
            *("--robot.controller=stance", "--robot.bridge.state_port=1"),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 5
    assert "egovcp-fake-g1" in result.stderr
    assert "Traceback" not in result.stderr
    assert list((tmp_path / "run").iterdir()) == []  # the same command can be repeated


@pytest.mark.slow
def test_an_episode_of_the_fake_g1_is_played_and_recorded(
    start: Start, short: list[str], tmp_path: Path
) -> None:
    outcomes = tmp_path / "outcomes.json"
    with fake_g1_process(*short, "--pause=60", f"--json={outcomes}") as fake:
        program = start(fake.ports)
        assert eventually(lambda: outcomes.is_file() or program.poll() is not None)
    words = program.communicate(timeout=240)[1]
    assert program.returncode == 6, words  # the robot is gone
    recording = read_recording(tmp_path / "run" / "rollout-0.mcap")
    assert recording.complete
    assert State.RUN in {tick.mode for tick in recording.ticks}
    (outcome,) = json.loads(outcomes.read_text())
    assert outcome["ticks"] == 15


def test_a_killed_run_leaves_no_process_and_listens_nowhere(drive: Callable[..., Stand]) -> None:
    stand = drive("--robot.limits.state_damp_s=3", "--robot.limits.state_hold_s=2")
    assert eventually(lambda: len(stand.modes()) > 3)
    program = psutil.Process(stand.program.pid)
    children = program.children(recursive=True)
    assert len(children) >= 2  # control, log
    connections = [c for p in (program, *children) for c in p.net_connections(kind="inet")]
    assert connections  # with the robot
    assert psutil.CONN_LISTEN not in {connection.status for connection in connections}
    stand.program.kill()
    stand.fake.faults.freeze_state = True  # a robot that may stand is held, not abandoned
    assert not psutil.wait_procs(children, timeout=300)[1]
    assert not stand.holds
