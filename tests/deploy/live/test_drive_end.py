"""The end of a live run, without processes: interrupts, messages, and a blocked terminal."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from egovcp.errors import SafetyStop
from egovcp.log.tick import Tick
from egovcp.spec import ACTION_DIM, STATE_DIM
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.live import drive as drive_module
from egovcp_deploy.live.display import Display
from egovcp_deploy.live.drive import drive
from egovcp_deploy.live.planner_loop import LiveSummary
from tests.support.pipes import full_pipe
from tests.support.sinks import MemorySink


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[LiveSummary], Path]:
    """`drive` of a loop with this result; Ctrl-C is pressed while its logs are closed."""

    def run(summary: LiveSummary) -> Path:
        class Loop:
            quitting = True
            interrupts = (signal.SIGINT,)

            def __init__(self, *arguments: object) -> None: ...

            def run(self, on_tick: object) -> LiveSummary:
                return summary

        @contextmanager
        def recording(*arguments: object, **options: object) -> Iterator[MemorySink]:
            (tmp_path / "out" / "rollout-0.mcap").touch()
            yield MemorySink()
            if summary.ticks:
                os.kill(os.getpid(), signal.SIGINT)

        @contextmanager
        def running_control(options: object) -> Iterator[SimpleNamespace]:
            process = SimpleNamespace(is_alive=lambda: False, kill=None, exitcode=0)
            watchdog = SimpleNamespace(expected=None, acted=False)
            yield SimpleNamespace(process=process, watchdog=watchdog, link=None)

        @contextmanager
        def nothing(options: object) -> Iterator[None]:
            yield None

        runner = SimpleNamespace(warm_up=lambda: None)
        replaced: dict[str, Any] = {
            "PlannerLoop": Loop,
            "PlannerRunner": lambda policy, imagine: runner,
            "backend_of": lambda policy: "",
            "open_operator": nothing,
            "open_viewer": nothing,
            "provenance_fields": lambda info: {},
            "recording": recording,
            "make_run_info": lambda *arguments: SimpleNamespace(backend=""),
            "running_control": running_control,
            "stop_control": lambda process, watchdog, interrupts: None,
        }
        for name, value in replaced.items():
            monkeypatch.setattr(drive_module, name, value)
        monkeypatch.setenv("OMP_NUM_THREADS", "1")
        artifact = SimpleNamespace(
            require_controller=lambda found: None, make_policy=lambda count, seed: None
        )
        config = replace(DeployConfig(), output_dir=str(tmp_path / "out"))
        drive(config, artifact)  # type: ignore[arg-type]
        return tmp_path / "out"

    return run


def test_ctrl_c_while_the_logs_are_closed_loses_no_report(
    run: Callable[[LiveSummary], Path], tmp_path: Path
) -> None:
    with pytest.raises(SafetyStop, match="emergency stop"):
        run(LiveSummary(ticks=3, damped="emergency stop"))
    assert json.loads((tmp_path / "out" / "deploy.json").read_text())["damped"] == "emergency stop"


def test_ctrl_c_before_the_first_observation_leaves_no_files(
    run: Callable[[LiveSummary], Path], tmp_path: Path
) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(LiveSummary())
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize(("held", "words"), [(5, " and the robot was held"), (0, "")])
def test_a_failure_says_that_the_robot_was_held_only_if_it_was(
    held: int, words: str, run: Callable[[LiveSummary], Path]
) -> None:
    with pytest.raises(SafetyStop, match=f"^the planner failed{words}: ZeroDivisionError"):
        run(LiveSummary(ticks=9, held=held, failure=ZeroDivisionError()))


def test_a_blocked_terminal_does_not_block_the_display(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = full_pipe()
    depth, state = np.zeros((48, 64), np.uint16), np.zeros(STATE_DIM, np.float32)
    action = np.zeros(ACTION_DIM)
    tick = Tick(0, 0, depth, state, action, action, mode="run", events=("x" * 1000,) * 100)
    with open(writer, "w") as full:
        monkeypatch.setattr(sys, "stderr", full)
        monkeypatch.setattr(sys, "stdout", full)
        begin = time.monotonic()
        display = Display()
        for _ in range(300):
            display.show(tick)
            display.warn("a warning")
        display.close()
        elapsed = time.monotonic() - begin
        os.close(reader)  # ends the blocked write
        display._thread.join(30.0)
        monkeypatch.undo()
        with suppress(BrokenPipeError):
            full.close()
    assert elapsed < 30.0
