"""egovcp-train on a LeRobot dataset of another robot, with features of its own."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from egovcp.artifact import load_artifact
from egovcp.data import open_dataset
from egovcp_train.train import main
from tests.support.arguments import Arguments
from tests.support.lerobot_datasets import ACTION, DEPTH, ONE, STATE, write_features

FEATURES = {
    "observation.images.wrist": {**DEPTH, "shape": (48, 64, 1)},
    "observation.state": STATE,
    "action": ACTION,
    "reward": {"dtype": "float32", **ONE},
}
NAMES = "--features={reward: reward}"


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("theirs") / "dataset"
    options = {"fps": 20, "use_videos": False}
    return write_features(root, FEATURES, [12] * 6, ("push the cube",), options)


def test_trains_and_resumes(theirs: Path, arguments: Arguments, tmp_path: Path) -> None:
    run = tmp_path / "run"
    too_long = arguments(run, NAMES, dataset__root=theirs, returns__steps=500)
    assert main(too_long) == 3  # after the conversion, whose result is removed
    assert not list(run.iterdir())
    assert main(arguments(run, NAMES, dataset__root=theirs)) == 0
    artifact = load_artifact(run / "checkpoints/last/pretrained_model")
    robot = artifact.robot
    assert (robot.robot_type, robot.planner_hz, robot.depth) == ("so100", 20, (48, 64))
    assert (robot.state_dim, robot.action_names) == (3, ("pan", "grip"))
    assert main([f"--output_dir={run}", "--resume", "--steps=8"]) == 0
    # The converted dataset is one like any other.
    assert len(open_dataset(run / "dataset")) == 6
    again = arguments(tmp_path / "again", dataset__root=run / "dataset")
    assert main(again) == 0


def test_the_output_folder_may_be_in_the_home_folder(
    theirs: Path, arguments: Arguments, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert main(arguments(Path("~/run"), NAMES, dataset__root=theirs, steps=1)) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert len(open_dataset(tmp_path / "run" / "dataset")) == 6


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("where", ["egovcp.data.convert._episode", "egovcp_train.train.prepare"])
def test_a_signal_before_the_first_step_leaves_no_dataset(
    where: str,
    number: int,
    theirs: Path,
    arguments: Arguments,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def unhandled(*_: object) -> None:
        pytest.fail("SIGTERM would end the process")

    monkeypatch.setattr(where, lambda *_: signal.raise_signal(number))
    previous = signal.signal(signal.SIGTERM, unhandled)
    try:
        assert main(arguments(tmp_path / "run", NAMES, dataset__root=theirs)) == 130
        assert signal.getsignal(signal.SIGTERM) is unhandled
    finally:
        signal.signal(signal.SIGTERM, previous)
    assert "egovcp-train: interrupted" in capsys.readouterr().err
    assert not list((tmp_path / "run").iterdir())


@pytest.mark.parametrize(
    ("flags", "problem"),
    [
        ((), "leave out --features"),
        (("--datasets=[{root: x}]",), "--features is for the --dataset of a new run"),
        (("--returns.weights={hit: 2.0}",), "one reward, without named terms"),
        (("--features={reward: rewrad}",), "did you mean 'reward'?"),
        (("--sampling.tasks={push: -1}",), "a weight of -1"),
        (("--resume",), "--features is for the --dataset of a new run"),
    ],
)
def test_refusals(
    flags: tuple[str, ...],
    problem: str,
    theirs: Path,
    arguments: Arguments,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    root = {} if not flags else {"dataset__root": theirs}
    run = tmp_path / "run"
    assert main(arguments(run, NAMES, **root) + list(flags)) == 2
    assert problem in capsys.readouterr().err
    assert not run.exists()


def test_resuming_with_features_keeps_the_run(
    arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = tmp_path / "dataset" / "kept"
    kept.parent.mkdir()
    kept.touch()
    assert main(arguments(tmp_path, NAMES, "--resume")) == 2
    assert "of a new run" in capsys.readouterr().err
    assert kept.exists()


def test_a_dataset_with_other_features_names_the_option(
    theirs: Path, arguments: Arguments, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments(tmp_path / "run", dataset__root=theirs)) == 3
    assert "--features" in capsys.readouterr().err
