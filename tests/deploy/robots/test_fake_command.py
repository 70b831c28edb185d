"""`egovcp-fake-g1` as a user starts it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from egovcp_deploy.robots.bridge import BridgeConfig, BridgeRobot
from egovcp_deploy.robots.fake.command import StepPacer, main
from tests.support.lockstep import LockstepClock

FLAGS = (
    "--ports.command_port=0",
    "--ports.state_port=0",
    "--ports.camera_port=0",
    "--env.controller=stance",
)


def start(*flags: str) -> subprocess.Popen[str]:
    module = "egovcp_deploy.robots.fake.command"
    return subprocess.Popen(
        [sys.executable, "-m", module, *FLAGS, *flags],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def ports_of(process: subprocess.Popen[str]) -> BridgeConfig:
    assert process.stdout is not None
    for line in process.stdout:
        if "listening" in line:
            assert "127.0.0.1" in line
            words = line.replace(",", "").replace(";", "").split()
            command, state = (int(words[words.index(w) + 1]) for w in ("commands", "states"))
            return BridgeConfig(state_port=state, command_port=command)
    raise AssertionError("it never listened")


def test_it_executes_console_commands_and_writes_outcomes(tmp_path: Path) -> None:
    out = tmp_path / "outcomes.json"
    process = start("--episodes=1", "--settle=0", "--pause=0", f"--json={out}")
    robot = BridgeRobot(ports_of(process))
    robot.connect()
    robot.close()
    assert process.stdin is not None
    process.stdin.write("nonsense\nrelease\n")  # without commands it falls
    process.stdin.flush()
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "unknown 'nonsense'" in text
    assert "fell after" in text
    (outcome,) = json.loads(out.read_text())
    assert outcome["fallen"]
    assert outcome["reward"] == pytest.approx(sum(outcome["reward_terms"].values()))


@pytest.mark.parametrize(("word", "code"), [("quit", 0), ("crash", 1)])
def test_it_ends_on_a_console_command(word: str, code: int) -> None:
    process = start()
    ports_of(process)
    process.communicate(f"{word}\n", timeout=60)
    assert process.returncode == code


def test_it_ends_on_an_interrupt() -> None:
    process = start()
    ports_of(process)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("flag", "code", "words"),
    [
        ("--task=bal", 2, "did you mean 'ball'"),
        ("--episode=-1", 2, "--episode=-1: expected at least 0"),
        ("--json=/dev/null/all.json", 2, "/dev/null is not a folder"),
    ],
)
def test_bad_options_are_refused(
    flag: str, code: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*FLAGS, flag]) == code
    assert words in capsys.readouterr().err


def test_late_steps_are_made_up_for_up_to_a_limit() -> None:
    clock = LockstepClock()
    pace = StepPacer(clock)
    assert [pace.wait_for_steps() for _ in range(3)] == [1, 1, 1]
    clock.advance(12_000_000)  # to 22 ms: those of 15 and 20 ms
    assert pace.wait_for_steps() == 2
    clock.advance(10_000_000_000)
    assert pace.wait_for_steps() == 20
    assert pace.wait_for_steps() == 1
