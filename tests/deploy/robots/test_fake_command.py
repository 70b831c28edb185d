"""`egovcp-fake-g1` as a user starts it."""

from __future__ import annotations

import io
import json
import queue
import signal
from pathlib import Path

import pytest

from egovcp_deploy.robots.bridge import BridgeRobot
from egovcp_deploy.robots.fake.command import StepPacer, _read_lines, main
from tests.support.lockstep import LockstepClock
from tests.support.robots.fake_g1 import bridge_config, fake_g1_process

STANCE = "--env.controller=stance"


def test_it_executes_console_commands_and_writes_outcomes(tmp_path: Path) -> None:
    out = tmp_path / "outcomes.json"
    flags = ("--episodes=1", "--settle=0", "--pause=1.5", f"--json={out}")
    with fake_g1_process(STANCE, *flags) as fake:
        assert fake.ports.host == "127.0.0.1"
        robot = BridgeRobot(bridge_config(fake))
        robot.connect()
        robot.close()
        assert fake.program.stdin is not None
        fake.program.stdin.write("nonsense\nrelease\n")  # without commands it falls
        fake.program.stdin.flush()
        text, _ = fake.program.communicate(timeout=60)
    assert fake.program.returncode == 0
    assert "unknown 'nonsense'" in text
    assert "fell after" in text
    (outcome,) = json.loads(out.read_text())
    assert outcome["fallen"]
    assert outcome["reward"] == pytest.approx(sum(outcome["reward_terms"].values()))


@pytest.mark.parametrize(("word", "code"), [("quit", 0), ("crash", 1)])
def test_it_ends_on_a_console_command(word: str, code: int) -> None:
    with fake_g1_process(STANCE) as fake:
        fake.program.communicate(f"{word}\n", timeout=60)
    assert fake.program.returncode == code


def test_the_report_is_written_on_quit(tmp_path: Path) -> None:
    with fake_g1_process(STANCE, f"--json={tmp_path / 'outcomes.json'}") as fake:
        fake.program.communicate("quit\n", timeout=60)
    assert json.loads((tmp_path / "outcomes.json").read_text()) == []


def test_it_ends_on_an_interrupt() -> None:
    with fake_g1_process(STANCE) as fake:
        fake.program.send_signal(signal.SIGINT)
        fake.program.communicate(timeout=60)
    assert fake.program.returncode == 0


@pytest.mark.parametrize(
    ("flag", "code", "words"),
    [
        ("--task=bal", 2, "did you mean 'ball'"),
        ("--episode=-1", 2, "--episode=-1: expected at least 0"),
        ("--pause=1", 2, "--pause=1.0: expected at least 1.5"),
        ("--json=/dev/null/all.json", 2, "/dev/null is not a folder"),
    ],
)
def test_bad_options_are_refused(
    flag: str, code: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([STANCE, flag]) == code
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("stdin", "expected"),
    [(None, []), (io.TextIOWrapper(io.BytesIO(b"\xff\nquit\n"), "utf-8"), ["\\xff", "quit"])],
    ids=["closed", "not UTF-8"],
)
def test_no_input_ends_the_reading_of_commands(
    stdin: io.TextIOWrapper | None, expected: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", stdin)
    lines = queue.SimpleQueue[str]()
    _read_lines(lines)
    assert [lines.get_nowait() for _ in range(lines.qsize())] == expected


def test_late_steps_are_made_up_for_up_to_a_limit() -> None:
    clock = LockstepClock()
    pace = StepPacer(clock)
    assert [pace.wait_for_steps() for _ in range(3)] == [1, 1, 1]
    clock.advance(12_000_000)  # to 22 ms: those of 15 and 20 ms
    assert pace.wait_for_steps() == 2
    clock.advance(10_000_000_000)
    assert pace.wait_for_steps() == 20
    assert pace.wait_for_steps() == 1
