"""``egovcp-train-ppo`` on the simulator: runs, resumes, refuses."""

import shutil
from importlib import resources
from pathlib import Path

import pytest

from egovcp.reactive import ReactiveNetwork
from egovcp.robot.stance import StanceController
from egovcp.sim import robot
from egovcp_train.checkpoint import load_training_state
from egovcp_train.ppo.train import main

SMALL = [
    "--robots=2",
    "--threads=1",
    "--ppo.num_steps_per_env=6",
    "--ppo.num_mini_batches=2",
    "--save_freq=1",
    "--env.controller=stance",
    "--env.ball_episode.ticks=5",
    "--env.ball_episode.event_ticks=[1,1]",
    "--tensorboard=false",
]
LAST = Path("checkpoints/last/pretrained_model/ppo.safetensors")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ppo") / "run"
    assert main([f"--output_dir={folder}", "--steps=24", *SMALL]) == 0
    return folder


def test_a_run_leaves_a_policy_and_goes_on_where_it_stopped(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = ReactiveNetwork.load(run / LAST)
    assert policy.controller_id == StanceController().id
    assert (policy.provenance["steps"], policy.provenance["tasks"]) == (24, ["ball"])
    before = load_training_state(run)
    assert before["episodes"] == 6  # two robots, twelve ticks, episodes of five
    assert main([f"--output_dir={run}", "--resume", "--steps=36"]) == 0
    assert "done after 36 steps" in capsys.readouterr().out
    after = load_training_state(run)
    assert (after["iteration"], before["iteration"]) == (3, 2)
    assert after["episodes"] == 10  # new ones: two at the start, and two that followed
    assert after["seconds"] > before["seconds"]
    assert ReactiveNetwork.load(run / LAST).provenance["steps"] == 36


def test_a_controller_of_a_relative_path_is_kept_with_its_absolute_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with resources.as_file(resources.files("egovcp.robot") / "g1_walk.safetensors") as shipped:
        shutil.copyfile(shipped, tmp_path / "walk.safetensors")
    monkeypatch.chdir(tmp_path)
    own = [flag for flag in SMALL if "controller" not in flag]
    controller = "--env.controller=walk.safetensors"
    assert main(["--output_dir=run", "--steps=12", controller, *own]) == 0
    options = (tmp_path / "run" / "train_config.yaml").read_text()
    assert f"controller: {tmp_path / 'walk.safetensors'}" in options


def test_another_network_does_not_continue_the_run(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([f"--output_dir={run}", "--resume", "--network.hidden=[8]"]) == 4
    assert "does not fit" in capsys.readouterr().err


def test_a_diverging_simulation_is_an_error_that_names_the_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(robot, "MAX_SPEED", 2.0)  # m/s; a ball is faster
    assert main([f"--output_dir={tmp_path}", "--steps=24", *SMALL]) == 3
    assert "the simulation diverged in task ball, seed 0" in capsys.readouterr().err


def test_a_diverging_training_is_an_error_and_its_weights_are_not_saved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [f"--output_dir={tmp_path}", "--steps=24", "--ppo.entropy_coef=1e39"]
    assert main([*flags, *SMALL]) == 3
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert "PPO diverged in iteration 1: a weight is not finite; none was saved" in message
    assert "--ppo.learning_rate" in message
    assert not (tmp_path / "checkpoints").exists()


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        (["--robots=0"], 2, "--robots"),
        (["--task=bal"], 2, "did you mean 'ball'"),
        (["--seed=1000000000"], 2, "are for evaluation"),
        (["--initial_std=0"], 2, "--initial_std"),
        (["--network.frames=0"], 2, "--network.frames=0: expected at least 1"),
        (["--network.hidden=[]"], 2, "--network.hidden=[]: expected at least one layer"),
        (["--robots=1", "--ppo.num_steps_per_env=3"], 2, "are 3 ticks per iteration; expected at"),
        (["--robots=1", "--ppo.num_steps_per_env=1", "--ppo.num_mini_batches=1"], 2, "at least 2"),
        (["--env.ball.mass_range=[1,1e6]"], 2, "at least 0.001 and at most 10"),
        (["--resume"], 4, "no checkpoint to resume from"),
    ],
)
def test_bad_options_are_refused(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    flags: list[str],
    code: int,
    message: str,
) -> None:
    assert main([f"--output_dir={tmp_path / 'new'}", *flags]) == code
    assert message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
