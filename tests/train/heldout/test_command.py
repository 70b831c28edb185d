"""``egovcp-eval-model``: what it writes, what it refuses."""

import json
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from egovcp.artifact import load_artifact, save_artifact
from egovcp.data import DatasetReader
from egovcp.dataset_options import DatasetConfig
from egovcp.plan import PlannerConfig
from egovcp.robot_spec import G1
from egovcp.testing import toy_model
from egovcp_train.heldout import command, report
from egovcp_train.heldout.command import main
from egovcp_train.heldout.report import EpisodeBatch
from egovcp_train.train import main as train
from tests.support.arguments import Arguments


@pytest.fixture(scope="module")
def policy(arguments: Arguments, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The artifact of a run of two steps."""
    output = tmp_path_factory.mktemp("policy") / "run"
    assert train(arguments(output, steps=2)) == 0
    return output / "checkpoints" / "last" / "pretrained_model"


def _argv(policy: Path, root: Path, output: Path, *flags: str) -> list[str]:
    named = {"policy.path": policy, "dataset.root": root, "output_dir": output, "threads": 1}
    return [*(f"--{k}={v}" for k, v in named.items()), "--device=cpu", *flags]


def test_metrics_pictures_and_a_table(
    policy: Path, dataset_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    assert main(_argv(policy, dataset_root, output, "--split=all", "--stride=2")) == 0
    content = json.loads((output / "heldout.json").read_text("utf-8"))
    found = content["tasks"]["ball"]
    assert (found["episodes"], found["rows"]) == (8, 7 * 24 + 15)
    assert found["termination"]["1"]["failing"] == 1
    # The returns are those of the training, over 5 steps: 20 rows of 24 have room for them.
    assert found["value"]["rows"] == 7 * 20 + 15
    assert content["_run"]["split"] == "all"
    assert {p.name for p in output.iterdir()} == {
        "heldout.json",
        "open_loop.rrd",
        "open_loop_ball.png",
        "value_ball.png",
    }
    with Image.open(output / "open_loop_ball.png") as picture:
        assert picture.width > picture.height
    assert "ball: 8 episodes" in capsys.readouterr().out


def test_an_interrupted_evaluation_keeps_what_was_measured(
    policy: Path,
    dataset_root: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupted(*args: Any) -> Iterator[EpisodeBatch]:
        for group in report.episode_batches(*args):
            yield group
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(report, "EPISODES_AT_ONCE", 3)
    monkeypatch.setattr(command, "episode_batches", interrupted)
    assert main(_argv(policy, dataset_root, tmp_path / "out", "--split=all")) == 130
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"heldout.json"}
    content = json.loads((tmp_path / "out" / "heldout.json").read_text("utf-8"))
    found = content["tasks"]["ball"]
    assert (found["incomplete"], found["episodes"], found["episodes_requested"]) == (True, 3, 8)
    assert content["_run"]["complete"] is False
    assert "INCOMPLETE: ball 3 of 8 episodes measured" in capsys.readouterr().out


def test_metrics_equal_those_of_the_training_run(
    policy: Path, dataset_root: Path, tmp_path: Path
) -> None:
    argv = _argv(policy, dataset_root, tmp_path, "--pictures=false")
    assert main(argv) == 0
    assert {p.name for p in tmp_path.iterdir()} == {"heldout.json"}
    content = json.loads((tmp_path / "heldout.json").read_text("utf-8"))
    trained = load_artifact(str(policy)).manifest
    for found in trained["heldout_tasks"].values():
        found["object_rmse_m"] = None  # a saved policy has no decoder of the object
    # Training compares Q with the privileged value, which is not part of a policy.
    for found in [*trained["heldout_tasks"].values(), *content["tasks"].values()]:
        del found["value"]
    for found in (trained["heldout"], content["all_tasks"]):
        for name in [name for name in found if name.startswith("value/")]:
            del found[name]
    assert content["tasks"] == trained["heldout_tasks"]
    del trained["heldout"]["object_rmse_m"]
    assert content["all_tasks"] == trained["heldout"]


def test_few_episodes_are_enough(policy: Path, dataset_root: Path, tmp_path: Path) -> None:
    argv = _argv(policy, dataset_root, tmp_path, "--split=all", "--episodes=2", "--pictures=false")
    assert main(argv) == 0
    content = json.loads((tmp_path / "heldout.json").read_text("utf-8"))
    assert content["tasks"]["ball"]["episodes"] == 2


@pytest.mark.parametrize(
    ("flag", "code", "message"),
    [
        ("--episodes=-1", 2, "--episodes=-1"),
        ("--stride=0", 2, "--stride=0"),
        ("--policy.path=", 2, "--policy.path is missing"),
        ("--split=test", 2, "unknown split 'test'"),
        ("--policy.path=/nowhere", 4, "no such folder: '/nowhere'"),
        ("--dataset.root=/nowhere", 3, "/nowhere"),
        ("--device=tpu9", 2, "unknown --device"),
    ],
)
def test_refusals(
    policy: Path,
    dataset_root: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    flag: str,
    code: int,
    message: str,
) -> None:
    name = flag.split("=")[0]
    argv = [a for a in _argv(policy, dataset_root, tmp_path / "out") if not a.startswith(name)]
    assert main([*argv, flag]) == code
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_data_of_another_controller_is_refused(
    dataset_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_artifact(tmp_path / "p", toy_model(), PlannerConfig(), {"controller_id": "walk-of-others"})
    assert main(_argv(tmp_path / "p", dataset_root, tmp_path / "out")) == 4
    said = capsys.readouterr().err
    assert "walk-of-others" in said
    assert DatasetReader.open(DatasetConfig(root=str(dataset_root))).controller_id in said


def test_data_of_another_robot_is_refused(
    dataset_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Converted datasets of different robots may have the same controller id, ``unknown``."""
    controller_id = DatasetReader.open(DatasetConfig(root=str(dataset_root))).controller_id
    model = toy_model(robot=replace(G1, robot_type="arm"))
    save_artifact(tmp_path / "p", model, PlannerConfig(), {"controller_id": controller_id})
    assert main(_argv(tmp_path / "p", dataset_root, tmp_path / "out")) == 2
    assert "on data of robot arm, " in capsys.readouterr().err


def test_results_are_never_overwritten(
    policy: Path, dataset_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "heldout.json").write_text("{}")
    assert main(_argv(policy, dataset_root, tmp_path)) == 2
    assert "exists and is not empty; choose another" in capsys.readouterr().err
    assert (tmp_path / "heldout.json").read_text() == "{}"


def test_numbers_that_are_not_finite_are_null(
    policy: Path, dataset_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = report.HeldoutReport({"value/r2": float("nan")}, {"ball": {"episodes": 8}}, {}, {})
    monkeypatch.setattr(command, "measure", lambda *args: result)
    monkeypatch.setattr(command, "table", lambda tasks: "")
    monkeypatch.setattr(command, "_show", lambda *args: None)
    assert main(_argv(policy, dataset_root, tmp_path, "--split=all")) == 0
    assert json.loads((tmp_path / "heldout.json").read_text())["all_tasks"] == {"value/r2": None}
