"""`egovcp-deploy --realtime=true`: simulator, control and logs in processes of one run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from egovcp.errors import DataError
from egovcp.log.mcap_reader import read_recording
from egovcp_deploy.pilot.states import State
from tests.support.robots.fake_g1 import eventually

from .conftest import PATIENT, QUICK

type Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start(artifact_dir: Path, tmp_path: Path, short: list[str]) -> Iterator[Start]:
    """Starts a run of a tiny planner that writes into ``tmp_path / "run"``."""
    programs = list[subprocess.Popen[str]]()

    def start(*flags: str) -> subprocess.Popen[str]:
        command = [
            *(sys.executable, "-m", "egovcp_deploy.deploy", "--realtime=true"),
            *(f"--policy.path={artifact_dir}", f"--output_dir={tmp_path / 'run'}"),
            *("--log.rrd=false", *short, *QUICK, *flags),
        ]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        program = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
        programs.append(program)
        return program

    yield start
    for program in programs:
        if program.poll() is None:
            program.kill()
        program.wait()


def listening(processes: Iterable[psutil.Process]) -> list[Any]:
    """Where they listen for connections from outside."""
    return [
        connection.laddr
        for process in processes
        for connection in process.net_connections(kind="inet")
        if connection.status == psutil.CONN_LISTEN
    ]


def test_an_episode_is_played_judged_and_recorded(start: Start, tmp_path: Path) -> None:
    program = start(*PATIENT, "--operator.duration=8")
    words = program.communicate(timeout=200)[1]
    assert program.returncode == 0, words
    recording = read_recording(tmp_path / "run" / "rollout-0.mcap")
    assert recording.complete
    assert State.RUN in {tick.mode for tick in recording.ticks}
    (outcome,) = json.loads((tmp_path / "run" / "task.json").read_text())
    assert outcome["ticks"] == 15


def test_a_run_listens_on_the_loopback_only_and_killed_leaves_no_process_behind(
    start: Start, tmp_path: Path
) -> None:
    program = start()

    def begun() -> bool:
        try:
            return len(read_recording(tmp_path / "run" / "rollout-0.mcap").ticks) > 3
        except DataError:
            return False

    assert eventually(begun)
    children = psutil.Process(program.pid).children(recursive=True)
    assert {address.ip for address in listening([psutil.Process(program.pid), *children])} == {
        "127.0.0.1"
    }
    program.kill()
    assert len(children) >= 3  # simulator, control, log
    assert not psutil.wait_procs(children, timeout=60)[1]
