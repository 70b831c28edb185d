"""`egovcp-compare`: pairs the episodes of two evaluations, and refuses what cannot be paired."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egovcp_deploy.compare import main
from egovcp_deploy.evaluate import main as evaluate


def write(folder: Path, rewards: list[float], task: str = "ball", **options: Any) -> str:
    """Write an `eval_run.json` whose episodes have these rewards; returns the folder."""
    played = [
        {"episode": i, "steps": 10, "reward": r, "success": r > 0, "terminated": False}
        for i, r in enumerate(rewards)
    ]
    config = {"seed": 0, "env": {"controller": "walk"}, "output_dir": str(folder), **options}
    folder.mkdir()
    content = {"config": config, "episodes": {task: {"planner": played}}}
    (folder / "eval_run.json").write_text(json.dumps(content))
    return str(folder)


def test_pairing_removes_the_variance_between_scenarios(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rewards spread by 1, one run is 0.1 better in each: 0.01 a step without any doubt."""
    hard = np.random.default_rng(0).normal(size=80)
    run = write(tmp_path / "run", (hard + 0.1).tolist())
    other = write(tmp_path / "other", hard[:60].tolist(), planner={"samples": 64})
    assert main([f"--run={run}", f"--other={other}"]) == 0
    out = capsys.readouterr().out
    assert "--planner: None (RUN), {'samples': 64} (OTHER)" in out
    assert "output_dir" not in out
    line = out.splitlines()[-1]
    assert line.split()[:2] == ["ball", "60"]
    assert line.endswith("+0.01000 (+0.01000 to +0.01000)")


def test_an_interrupted_run_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    run, other = (write(tmp_path / name, [0.1, -0.1]) for name in ("run", "other"))
    path = Path(run) / "eval_run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"complete": False}))
    assert main(["--run=~/run", "--other=~/other"]) == 0
    printed = capsys.readouterr().out
    assert f"{run} is incomplete: egovcp-eval was interrupted" in printed
    assert f"{other} is incomplete" not in printed


def test_two_controllers_of_one_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From end to end: what egovcp-eval writes is what is read."""
    out = tmp_path / "out"
    flags = ["--controllers=hold,random", "--episodes=3", "--env.controller=stance"]
    flags += ["--env.ball_episode.ticks=15", "--env.ball_episode.event_ticks=[2,3]"]
    assert evaluate([f"--output_dir={out}", "--num_workers=1", *flags]) == 0
    printed = capsys.readouterr().out
    assert main([f"--run={out}", "--controller=hold", "--other_controller=random"]) == 0
    line = capsys.readouterr().out.splitlines()[-1].split()
    rates = [x.split()[2] for x in printed.splitlines() if x.startswith("ball ")]
    assert line[:4] == ["ball", "3", *rates]


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        ([], 2, "--run is missing"),
        (["--run=a"], 2, "--other"),
        (["--run=a", "--other=missing"], 3, "a folder that egovcp-eval wrote"),
        (["--run=a", "--other=torn"], 3, "not what egovcp-eval writes"),
        (["--run=a", "--other=later"], 2, "nothing can be paired"),
        (["--run=a", "--other=wall"], 2, "no task in common: ball and wall"),
        (["--run=a", "--other=none"], 2, "no scenario of ball was played by both"),
        (["--run=a", "--other=a", "--controller=planer"], 2, "did you mean 'planner'"),
    ],
)
def test_runs_that_cannot_be_compared_are_refused(
    flags: list[str],
    code: int,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write(Path("a"), [1.0])
    write(Path("later"), [1.0], seed=1)
    write(Path("wall"), [1.0], task="wall")
    write(Path("none"), [])
    Path("torn").mkdir()
    Path("torn/eval_run.json").write_text('{"config": {}')
    assert main(flags) == code
    assert message in capsys.readouterr().err
