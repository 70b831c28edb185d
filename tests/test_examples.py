"""The scripts in examples/ run, at a reduced size."""

import runpy
import tomllib
from pathlib import Path

import pytest

from egovcp.checks import check_task
from tests.support.plugins import install

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
_SMALL = ["--preset=debug", "--steps=2", "--batch_size=2", "--eval_freq=0", "--threads=1"]


def test_examples_train_a_policy_and_imagine_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quickstart = runpy.run_path(str(EXAMPLES / "quickstart.py"))
    rate = quickstart["run"](tmp_path, episodes=2, minutes=0, scenarios=1, options=_SMALL)
    assert 0.0 <= rate <= 1.0
    capsys.readouterr()

    imagine = runpy.run_path(str(EXAMPLES / "imagine.py"))
    policy = tmp_path / "policy/checkpoints/last/pretrained_model"
    imagine["main"](str(policy), str(tmp_path / "dataset"))
    assert capsys.readouterr().out.count("Q = ") == 2


@pytest.mark.parametrize("task", ["bag", "table"])
def test_example_tasks_conform_and_their_oracles_succeed(
    task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = EXAMPLES / "tasks" / task
    source = (folder / f"{task}_task.py").read_text()
    assert len(source.splitlines()) <= 150
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    (entry,) = project["entry-points"]["egovcp.tasks"].items()
    install(tmp_path, task, source, " = ".join(entry), monkeypatch)
    report = check_task(task, episodes=1)
    assert report.success_rate["oracle"] == 1.0
    assert report.success_rate["hold"] == 0.0
