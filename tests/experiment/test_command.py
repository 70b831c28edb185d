"""`egovcp-experiment`: misuse is explained, and one small experiment works from end to end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from egovcp import packages
from egovcp.artifact import PRETRAINED, save_artifact
from egovcp.data import DatasetWriter, Provenance
from egovcp.errors import EnvironmentFailure
from egovcp.manifest import SEAL, read_manifest
from egovcp.plan import PlannerConfig
from egovcp.testing import random_episode, toy_model
from egovcp_experiment.command import main, with_local_policies
from egovcp_experiment.config import SCALES, TrainingConfig
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.scheduler import CellScheduler
from egovcp_experiment.store import CellStore


def test_help_lists_every_experiment(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    for name, experiment in EXPERIMENTS.items():
        assert name in out
        assert experiment.summary in out


@pytest.mark.parametrize(
    ("flag", "budget_ms"), [("--jobs=1", 12.0), ("--scale=paper", 40.0), ("--config_path", 5.0)]
)
def test_help_shows_the_defaults_of_the_scale(
    flag: str, budget_ms: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if flag == "--config_path":
        (tmp_path / "options.yaml").write_text("scale: smoke")
        flag = f"{flag}={tmp_path / 'options.yaml'}"
    with pytest.raises(SystemExit):
        main(["planners", flag, "--help=play"])
    assert f"(default: {budget_ms})" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], ""),
        (["planer"], "did you mean 'planners'"),
        (["planners"], "--output_dir is missing"),
        (["planners", "--scale=smal", "--output_dir=x"], "did you mean 'small'"),
        (["planners", "--output_dir=x", "--scenes=[--seed=3]"], "expected --env.NAME=value"),
        (
            ["planners", "--output_dir=x", "--scenes=[--env.bal.shape=box]"],
            "--scenes: unknown option",
        ),
        (["planners", "--output_dir=x", "--data.flags=[--num_env=8]"], "did you mean '--num_envs'"),
        (["planners", "--output_dir=x", "--train.flags=[--batch_size=0]"], "--train.flags: "),
        (["planners", "--output_dir=x", "--play.flags=[--num_envs=x]"], "--play.flags: "),
        (["ppo", "--output_dir=x", "--ppo.flags=[--ppo.entropy_coef=x]"], "--ppo.flags: "),
        (["sample-efficiency", "--output_dir=x", "--train.flags=[--save_freq=0]"], "--save_freq=0"),
        (["table1", "--output_dir=x", "--train.flags=[--seed=3]"], "give --train.seeds"),
        (["planners", "--output_dir=x", "--only=[cme]"], "did you mean 'cem'"),
        (["planners", "--output_dir=x", "--jobs=0"], "--jobs=0"),
        (["planners", "--scale=small", "--config_path=a.yaml"], "both set options"),
        (["table1", "--output_dir=x", "--train.seeds=[0,1,0]"], "[0, 1, 0]: expected at least one"),
        (["table1", "--output_dir=x", "--train.seeds=[-1]"], "--train.seeds=[-1]"),
        (["table1", "--output_dir=x", "--tasks=[ball, ball]"], "none twice"),
        (["table1", "--output_dir=x", "--data.parts=[0]"], "--data.parts=[0.0]"),
        (["table1", "--output_dir=x", "--data.roots={bal: y}"], "did you mean 'ball'"),
        (["table1", "--output_dir=x", "--train.policies={wal: y}"], "did you mean 'wall'"),
        (["table1", "--output_dir=x", "--train.steps=0"], "expected at least 1"),
        (["ablations", "--output_dir=x", "--train.preset=paper"], "--train.preset=paper"),
        (["multitask", "--output_dir=x", "--tasks=[ball]"], "give at least two tasks"),
        (["variance", "--output_dir=x", "--only=[horizon_1]"], "--only: this experiment has no"),
        (["ppo", "--output_dir=x", "--scale=smoke", "--most=1"], "--most: this experiment has no"),
    ],
)
def test_misuse_ends_with_2_before_anything_is_written(
    argv: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(argv) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.glob("x/cells/*.json"))


def test_a_missing_package_is_named_before_any_cell_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(packages, "is_installed", lambda name: name != "rsl_rl")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert main(["ppo", "--output_dir=~/out", "--scale=smoke"]) == 5
    message = capsys.readouterr().err
    assert "egovcp-train-ppo needs rsl-rl-lib, which is not installed" in message
    assert "egovcp-train[lowlevel]" in message
    assert (tmp_path / "out" / "cells").is_dir()
    assert not (tmp_path / "out" / "logs").exists()


@pytest.mark.parametrize(
    ("flag", "code", "message"),
    [
        ("--data.roots={{ball: {folder}/none}}", 3, "--data.roots: ball: no such folder"),
        ("--train.policies={{ball: {folder}}}", 4, "--train.policies: ball:"),
    ],
)
def test_a_dataset_or_policy_that_cannot_be_used_is_refused_before_any_cell_runs(
    flag: str, code: int, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["table1", f"--output_dir={tmp_path / 'out'}", "--scale=smoke"]
    assert main([*argv, flag.format(folder=tmp_path)]) == code
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out" / "logs").exists()


def test_a_dataset_of_another_task_is_refused_before_any_cell_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset_root = tmp_path / "dataset"
    with DatasetWriter(dataset_root, Provenance("walk-1", seed=0, command="collect")) as writer:
        writer.add(random_episode(0))
    argv = ["table1", f"--output_dir={tmp_path / 'out'}", "--scale=smoke"]
    assert main([*argv, f"--data.roots={{wall: {dataset_root}}}"]) == 2
    assert "--data.roots: wall: " in (err := capsys.readouterr().err)
    assert "holds ball of robot unitree_g1; expected wall of the G1" in err
    assert not (tmp_path / "out" / "logs").exists()


def test_a_policy_on_the_hub_is_that_of_one_download(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit = tmp_path / "models" / "commit"
    save_artifact(commit, toy_model(), PlannerConfig(), {"controller_id": "walk-1"})
    monkeypatch.setattr("egovcp.artifact.snapshot", lambda *args, **options: commit)
    config = replace(
        SCALES["smoke"](), train=TrainingConfig(seeds=(0,), policies={"all": "me/policy"})
    )
    given = with_local_policies(config)
    cells = {cell.name: cell for cell in EXPERIMENTS["generalise"].cells(given)}
    cell = cells["play-ball-default-s0"]
    assert f"--policy.path={commit}" in (store := CellStore(tmp_path / "out")).prepare(cell)
    seal = read_manifest(commit)[SEAL]
    assert store.settings(cell)["flags"]["policy.path"] == {"sha256": seal}


def test_a_shipped_policy_keeps_its_name_and_is_identified_by_its_content(tmp_path: Path) -> None:
    config = replace(
        SCALES["smoke"](), train=TrainingConfig(seeds=(0,), policies={"all": "contact"})
    )
    cells = {c.name: c for c in EXPERIMENTS["generalise"].cells(with_local_policies(config))}
    cell = cells["play-ball-default-s0"]
    assert "--policy.path=contact" in (store := CellStore(tmp_path / "out")).prepare(cell)
    seal = read_manifest(PRETRAINED / "contact")[SEAL]
    assert store.settings(cell)["flags"]["policy.path"] == {"sha256": seal}


@pytest.mark.parametrize("broken", [False, True])
def test_failed_cells_are_named_whether_or_not_there_is_a_report(
    broken: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(*args: object) -> None:
        raise EnvironmentFailure("cell a failed")

    def break_down(*args: object) -> None:
        raise KeyError("metrics")

    monkeypatch.setattr(CellScheduler, "run", fail)
    if broken:
        monkeypatch.setattr("egovcp_experiment.command.publish", break_down)
    assert main(["planners", f"--output_dir={tmp_path / 'out'}", "--scale=smoke"]) == 5
    out, err = capsys.readouterr()
    assert err.endswith("cell a failed\n")
    assert ("the report could not be written: KeyError('metrics')" in err) == broken
    assert ("report: " in out) != broken


@pytest.mark.slow
def test_an_experiment_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Collects, trains and reports through the real commands; again, nothing is left to do."""
    out = tmp_path / "out"
    argv = ["ablations", "--scale=smoke", f"--output_dir={out}", "--tasks=[ball]"]
    argv += ["--only=[value_two_hot]", "--data.episodes.ball=10", "--data.flags=[--num_workers=1]"]
    assert main(argv) == 0
    content = json.loads((out / "ablations.json").read_text())
    assert list(content["cells"]) == ["collect-ball-10", "ablate-ball-value_two_hot-s0"]
    assert content["missing"] == []
    assert content["cells"]["collect-ball-10"]["metrics"]["episodes"] == 10
    assert "policy.value_loss=two_hot" in (out / "ablations.md").read_text()
    checkpoints = out / "work" / "ablate-ball-value_two_hot-s0" / "checkpoints"
    model = json.loads((checkpoints / "last" / "pretrained_model" / "config.json").read_text())
    assert model["world_model"]["value_loss"] == "two_hot"
    capsys.readouterr()
    assert main(argv) == 0
    assert "2 cells, 2 complete" in capsys.readouterr().out
    assert json.loads((out / "ablations.json").read_text())["cells"] == content["cells"]
