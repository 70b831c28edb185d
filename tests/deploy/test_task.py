"""`egovcp-task`, and packages of tasks that are given by reference."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import egovcp.sim.tasks.registry as registry
from egovcp.entry_point import EntryPoint
from egovcp_deploy.task import main
from tests.support.plugins import install


def run(package: Path, *args: str) -> subprocess.CompletedProcess[str]:
    """Run Python in the folder of a package, with the modules of this process."""
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, *args]
    return subprocess.run(
        command, cwd=package, env=environ, capture_output=True, text=True, check=False
    )


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package for the task ``reach``, as `egovcp-task new` writes it; its folder is current."""
    assert main(["new", "reach", f"--output_dir={tmp_path / 'new'}"]) == 0
    monkeypatch.setattr(registry, "_found", None)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv(registry.VARIABLE, "")
    monkeypatch.delitem(sys.modules, "reach_task", raising=False)
    monkeypatch.chdir(tmp_path / "new")
    return tmp_path / "new"


def test_the_next_commands_can_be_pasted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["new", "grip", f"--output_dir={tmp_path / 'with space'}"]) == 0
    assert f"pip install -e '{tmp_path / 'with space'}'" in capsys.readouterr().out


def test_list_names_tasks_and_what_provides_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path, "bad", "import nothing_of_this_name", "bad = bad_task:Bad", monkeypatch)
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["ball", "wall", "arch", "sequence", "bad"]
    assert "block a thrown ball" in lines[0]
    assert "egovcp-task-bad 1.2  ! ModuleNotFoundError: No module" in lines[-1]


def test_the_skeleton_conforms_and_its_own_test_passes(package: Path) -> None:
    files = ("README.md", "pyproject.toml", "reach_task.py", "test_reach_task.py")
    assert tuple(sorted(path.name for path in package.iterdir())) == files
    assert "@" not in "".join((package / f).read_text().replace("@classm", "") for f in files[1:2])
    done = run(package, "-m", "pytest", "-q", "-p", "no:cacheprovider", ".")
    assert done.returncode == 0, done.stdout


def test_a_task_is_checked_by_reference_with_its_options(package: Path) -> None:
    task = "import sys; from egovcp_deploy.commands import task; sys.exit(task())"
    short = "--env.reach_episode={ticks: 6, event_ticks: [1, 2], empty_probability: 0}"
    flags = ("--episodes=1", "--env.reach.touch_reward=2", short)
    checked = run(package, "-c", task, "check", "reach_task:ReachTask", *flags)
    assert "reach conforms: " in checked.stdout, checked.stderr


def test_play_records_for_rerun_and_as_gif(tmp_path: Path) -> None:
    short = "--env.ball_episode={ticks: 4, event_ticks: [1, 2], empty_probability: 0}"
    assert main(["play", "ball", "--controller=hold", short, f"--output_dir={tmp_path}"]) == 0
    assert {"rollout-0.rrd", "rollout-0.gif"} <= {path.name for path in tmp_path.iterdir()}


def test_a_reference_that_cannot_be_imported_is_one_line(
    package: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    evaluate = EntryPoint("egovcp-eval", "egovcp_deploy.evaluate")
    assert evaluate(["--task=reach_task:Nothing"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("egovcp-eval: error: task reach_task:Nothing cannot be used: ")
    assert "has no attribute 'Nothing'" in line


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["new", "9bag"], "'9bag' cannot be the name of a task: .*a letter first"),
        (["new", "camera"], "'camera' cannot be the name of a task: it is an option of --env"),
        (["new", "bag_episode"], "'bag_episode' cannot .*: names of options end in _episode"),
        (["new", "ball"], "egovcp .* has a task 'ball'"),
        (["check", "bal"], "did you mean 'ball'"),
        (["play", "ball", "--controller=best"], "expected hold or random or oracle"),
    ],
)
def test_wrong_arguments_are_usage_errors(
    args: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(args) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(message, line)
