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
from egovcp_deploy.pilot.states import State
from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from tests.support.robots.fake_g1 import eventually, fake_g1_process

from .conftest import PATIENT, QUICK

_PROGRAM = """
import signal, sys
from egovcp_deploy.commands import deploy
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores SIGHUP, and the test sends it
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
class LiveRun:
    """A fake G1 that a thread steps in real time, and a program that drives it."""

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
        assert self.program.poll() is None, self.stderr()

    def modes(self) -> list[str]:
        """Mode of each tick recorded so far."""
        try:
            recording = read_recording(self.folder / "rollout-0.mcap")
        except DataError:  # nothing has been written yet
            return []
        return [tick.mode for tick in recording.ticks]

    def stderr(self) -> str:
        """Wait for the end; returns stderr."""
        return self.program.communicate(timeout=240)[1]


type Start = Callable[..., subprocess.Popen[str]]


def _command(artifact: Path, output: Path, *flags: str, before: str = "") -> list[str]:
    """Command line of a run; ``before`` is executed first."""
    return [
        *(sys.executable, "-c", before + _PROGRAM, "--robot.type=unitree_g1"),
        *(f"--policy.path={artifact}", f"--output_dir={output}", "--robot.controller=stance"),
        "--operator.type=auto",
        *flags,
    ]


@pytest.fixture
def start(artifact_dir: Path, tmp_path: Path) -> Iterator[Start]:
    """Starts a run of a tiny planner, recorded in ``tmp_path / "run"``."""
    programs = list[subprocess.Popen[str]]()

    def start(ports: Ports, *flags: str, before: str = "") -> subprocess.Popen[str]:
        options = [
            *("--log.rrd=false", "--log.videos=0"),
            f"--robot.bridge.state_port={ports.state_port}",
            f"--robot.bridge.command_port={ports.command_port}",
            f"--robot.camera.server.port={ports.camera_port}",
            *(*QUICK, *PATIENT, *flags),
        ]
        command = _command(artifact_dir, tmp_path / "run", *options, before=before)
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
def drive(fake: FakeBridge, start: Start, tmp_path: Path) -> Callable[..., LiveRun]:
    def drive(*flags: str, before: str = "") -> LiveRun:
        return LiveRun(fake, start(fake.ports, *flags, before=before), tmp_path / "run")

    return drive


@pytest.mark.slow
def test_a_run_stands_up_runs_holds_and_leaves_the_motors_damped(
    drive: Callable[..., LiveRun],
) -> None:
    run = drive("--operator.duration=1", "--log.videos=1")
    stderr = run.stderr()
    assert run.program.returncode == 0, stderr
    modes = run.modes()
    order = [State.INIT, State.STAND, State.ARMED, State.RUN, State.HOLD]
    assert list(dict.fromkeys(modes)) == order
    assert not run.holds
    report = json.loads((run.folder / "deploy.json").read_text())
    assert report["ticks_running"] == pytest.approx(modes.count(State.RUN), abs=1)
    assert report["damped"] == ""
    assert report["missing_ticks"] == {"rollout-0.mcap": 0}


def test_killing_the_control_process_damps_the_robot_and_ends_with_a_safety_stop(
    drive: Callable[..., LiveRun],
) -> None:
    run = drive()
    run.await_run()
    assert run.holds
    run.control.kill()
    assert eventually(lambda: not run.holds)
    stderr = run.stderr()
    assert run.program.returncode == 6, stderr
    assert "the control process died" in stderr
    recording = read_recording(run.folder / "rollout-0.mcap")
    assert recording.complete
    assert recording.ticks[-1].events[-1] == "end of the run: the control process is gone"


def kill(program: subprocess.Popen[str]) -> None:
    program.kill()


def hang_up(program: subprocess.Popen[str]) -> None:
    """Send SIGHUP, as a closing terminal does."""
    os.killpg(program.pid, signal.SIGHUP)


@pytest.mark.slow
@pytest.mark.parametrize("end", [kill, hang_up])
def test_killing_the_planner_leaves_the_robot_standing_until_sigterm(
    drive: Callable[..., LiveRun], end: Callable[[subprocess.Popen[str]], None]
) -> None:
    run = drive()
    run.await_run()
    control = run.control
    others = psutil.Process(run.program.pid).children(recursive=True)
    commands = {p.pid: " ".join(p.cmdline()) for p in others}
    end(run.program)
    run.program.wait()
    received: list[bytes] = []
    run.fake.on_command = received.append
    assert eventually(lambda: len(received) > 50)
    assert run.holds
    needed = {control.pid, *(p.pid for p in others if "resource_tracker" in commands[p.pid])}
    assert not psutil.wait_procs([p for p in others if p.pid not in needed], timeout=60)[1]
    control.terminate()
    assert eventually(lambda: not control.is_running() or control.status() == "zombie")
    assert not run.holds
    assert f"damped: by kill {control.pid}" in run.stderr()
    assert not psutil.wait_procs(others, timeout=60)[1]
    recording = read_recording(run.folder / "rollout-0.mcap")
    assert State.RUN in [tick.mode for tick in recording.ticks]


@pytest.mark.slow
def test_a_planner_exception_leaves_the_robot_standing_until_the_second_interrupt(
    drive: Callable[..., LiveRun],
) -> None:
    run = drive(before=_FAILING)
    assert eventually(lambda: run.modes()[-1:] == [State.HOLD])
    ticks = len(run.modes())
    run.program.send_signal(signal.SIGINT)
    assert eventually(lambda: len(run.modes()) > ticks + 25)
    assert run.modes()[-1] == State.HOLD
    assert run.holds
    run.program.send_signal(signal.SIGINT)
    assert eventually(lambda: not run.holds)
    stderr = run.stderr()
    assert run.program.returncode == 6, stderr
    assert "the planner failed: ZeroDivisionError: a mistake" in stderr
    assert "Traceback" not in stderr
    report = json.loads((run.folder / "deploy.json").read_text())
    assert report["failure"] == "ZeroDivisionError: a mistake"


def test_the_first_interrupt_holds_the_second_damps(drive: Callable[..., LiveRun]) -> None:
    run = drive()
    run.await_run()
    run.program.send_signal(signal.SIGINT)
    assert eventually(lambda: run.modes()[-1] == State.HOLD)
    assert run.holds
    run.program.send_signal(signal.SIGINT)
    assert eventually(lambda: not run.holds)
    stderr = run.stderr()
    assert run.program.returncode == 6, stderr
    # The latter if the machine was too busy for the control process to answer in time.
    assert "emergency stop" in stderr or "the control process died" in stderr


@pytest.mark.slow
def test_missing_robot_states_damp_and_exit_with_a_safety_stop(
    drive: Callable[..., LiveRun],
) -> None:
    run = drive("--robot.limits.state_damp_s=3", "--robot.limits.state_hold_s=2")
    run.await_run()
    run.fake.faults.freeze_state = True
    assert eventually(lambda: not run.holds)
    stderr = run.stderr()
    assert run.program.returncode == 6, stderr
    assert "no new proprioception" in stderr


@pytest.mark.slow
def test_a_missing_robot_is_reported_at_once(artifact_dir: Path, tmp_path: Path) -> None:
    command = _command(artifact_dir, tmp_path / "run", "--robot.bridge.state_port=1")
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
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
    stderr = program.communicate(timeout=240)[1]
    assert program.returncode == 6, stderr  # the robot is gone
    recording = read_recording(tmp_path / "run" / "rollout-0.mcap")
    assert recording.complete
    assert State.RUN in {tick.mode for tick in recording.ticks}
    (outcome,) = json.loads(outcomes.read_text())
    assert outcome["ticks"] == 15


def test_a_run_opens_no_listening_socket(drive: Callable[..., LiveRun]) -> None:
    run = drive()
    assert eventually(lambda: len(run.modes()) > 3)
    program = psutil.Process(run.program.pid)
    processes = (program, *program.children(recursive=True))
    connections = [c for p in processes for c in p.net_connections(kind="inet")]
    assert connections  # with the robot
    assert psutil.CONN_LISTEN not in {connection.status for connection in connections}


def test_a_killed_run_ends_all_its_processes(drive: Callable[..., LiveRun]) -> None:
    run = drive("--robot.limits.state_damp_s=3", "--robot.limits.state_hold_s=2")
    assert eventually(lambda: len(run.modes()) > 3)
    children = psutil.Process(run.program.pid).children(recursive=True)
    assert len(children) >= 2  # control, log
    run.program.kill()
    # the control process ends only once the robot no longer answers
    run.fake.faults.freeze_state = True
    assert not psutil.wait_procs(children, timeout=300)[1]
    assert not run.holds
