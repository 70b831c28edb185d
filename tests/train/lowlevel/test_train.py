"""``egovcp-train-lowlevel``: runs, resumes, refuses."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from egovcp import packages
from egovcp.robot.controllers import load_walk_policy
from egovcp.robot.walk_policy import WalkPolicy
from egovcp.robot.walking import OBSERVATION_DIM, WalkConfig, WalkingController
from egovcp.sim.config import SensorConfig
from egovcp.spec import STATE_DIM
from egovcp_train.lowlevel.config import (
    CurriculumConfig,
    LowLevelTask,
    NetworkConfig,
    RewardConfig,
)
from egovcp_train.lowlevel.env import LowLevelEnv
from egovcp_train.lowlevel.learner import (
    LowLevelLearner,
    SymmetricStart,
    next_difficulty,
    walk_policy,
)
from egovcp_train.lowlevel.train import main
from egovcp_train.on_policy import RslRlPpoConfig

SMALL = ["--robots=8", "--threads=1", "--ppo.num_steps_per_env=8", "--save_freq=2"]
LAST = Path("checkpoints/last/pretrained_model/walk.safetensors")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lowlevel") / "run"
    assert main([f"--output_dir={folder}", "--steps=192", *SMALL]) == 0
    return folder


def test_a_run_leaves_a_controller_that_drives_the_robot(run: Path):
    policy = WalkPolicy.load(run / LAST)
    assert policy.provenance["steps"] == 192
    assert policy.config == WalkConfig()
    state = np.zeros((1, STATE_DIM))
    state[:, 5] = -1.0
    assert np.isfinite(WalkingController(policy).step(state)).all()
    assert (run / LAST).stat().st_size < 2_000_000


def test_a_run_from_a_controller_takes_its_parameters_unless_they_are_given(tmp_path: Path):
    flags = ["--init=walk", "--network.actor=[256,128,64]", "--steps=64", *SMALL]
    assert (
        main([f"--output_dir={tmp_path / 'run'}", *flags, "--walk.balance.height_speed=0.3"]) == 0
    )
    found, shipped = (
        WalkPolicy.load(tmp_path / "run" / LAST).config,
        load_walk_policy("walk").config,
    )
    assert found.gait == shipped.gait
    assert found.reach == shipped.reach
    assert found.balance == replace(shipped.balance, height_speed=0.3)


def test_a_run_resumed_in_the_warm_up_of_the_critic_still_fits_the_actor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    fitted = []
    monkeypatch.setattr(SymmetricStart, "fit", lambda *args: fitted.append(1) or 0.0)
    flags = ["--init=walk", "--network.actor=[256,128,64]", "--critic_warmup=2", *SMALL]
    assert main([f"--output_dir={tmp_path / 'run'}", "--steps=64", *flags]) == 0
    assert main([f"--output_dir={tmp_path / 'run'}", "--resume", "--steps=192"]) == 0
    assert len(fitted) == 2


def test_it_goes_on_where_it_stopped(run: Path, capsys: pytest.CaptureFixture[str]):
    assert main([f"--output_dir={run}", "--resume", "--steps=320"]) == 0
    assert "done after 320 steps" in capsys.readouterr().out
    assert WalkPolicy.load(run / LAST).provenance["steps"] == 320


@pytest.mark.parametrize(
    ("flags", "code", "message"),
    [
        (["--robots=0"], 2, "--robots"),
        (["--robot=8"], 2, "robot"),
        (["--task.episode=0.005"], 2, "--task.episode=0.005"),
        (["--task.rewards.alive=1e308"], 2, "--task.rewards.alive=1e+308: expected at least"),
        (["--network.actor=[]"], 2, "--network.actor=[]: expected at least one layer"),
        (["--robots=1", "--ppo.num_steps_per_env=3"], 2, "are 3 ticks per iteration; expected at"),
        (["--resume"], 4, "no checkpoint to resume from"),
    ],
)
def test_bad_options_are_refused(tmp_path, capsys, flags, code, message):
    assert main([f"--output_dir={tmp_path / 'new'}", *flags]) == code
    assert message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_missing_package_is_named_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(packages, "is_installed", lambda name: name != "onnx")
    assert main([f"--output_dir={tmp_path / 'new'}", *SMALL]) == 5
    assert "egovcp-train-lowlevel needs onnx" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_folder_with_something_in_it_is_left_alone(tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("mine")
    assert main([f"--output_dir={tmp_path}", *SMALL]) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_another_network_does_not_continue_the_run(run: Path, capsys):
    assert main([f"--output_dir={run}", "--resume", "--network.actor=[8]"]) == 4
    assert "does not fit" in capsys.readouterr().err


def _learner(**curriculum: float) -> LowLevelLearner:
    env = LowLevelEnv(4, LowLevelTask(), WalkConfig(), SensorConfig())
    return LowLevelLearner(
        env,
        NetworkConfig(actor=(16,), critic=(16,)),
        RslRlPpoConfig(num_steps_per_env=4),
        CurriculumConfig(**curriculum),
    )


def test_the_exported_policy_is_the_trained_one():
    learner = _learner()
    learner.iterate()
    policy = walk_policy(learner.ppo.get_policy(), WalkConfig(), {})
    x = learner.env.get_observations()
    learner.ppo.eval_mode()
    with torch.no_grad():
        expected = learner.ppo.get_policy()(x).numpy()
    np.testing.assert_allclose(policy(x["policy"].numpy()), expected, atol=1e-3)
    assert policy.mean.shape == (OBSERVATION_DIM,)


def test_it_becomes_harder_with_success_and_easier_with_falls():
    rule = CurriculumConfig(step=0.1)
    assert next_difficulty(0.0, falls=0.0, tracked=0.9, rule=rule) == pytest.approx(0.1)
    assert next_difficulty(0.1, falls=0.0, tracked=0.1, rule=rule) == pytest.approx(0.1)
    assert next_difficulty(0.1, falls=1.0, tracked=0.9, rule=rule) == pytest.approx(0.0)
    assert next_difficulty(0.95, falls=0.0, tracked=0.9, rule=rule) == 1.0
    assert next_difficulty(0.05, falls=1.0, tracked=0.9, rule=rule) == 0.0


def test_ppo_learns_what_a_term_rewards():
    """With nothing but the cost of acting, it acts less and less boldly."""
    task = LowLevelTask(rewards=_only_action(RewardConfig()))
    env = LowLevelEnv(16, task, WalkConfig(), SensorConfig())
    learner = LowLevelLearner(
        env,
        NetworkConfig(actor=(16,), critic=(16,)),
        RslRlPpoConfig(entropy_coef=0.0, desired_kl=0.05),
        CurriculumConfig(),
    )
    torch.manual_seed(0)
    for _ in range(18):
        scalars = learner.iterate()
    assert scalars["ppo/action_std"] < 0.98 * NetworkConfig().initial_std


def _only_action(rewards: RewardConfig) -> RewardConfig:
    none = {f.name: 0.0 for f in fields(rewards)}
    return replace(rewards, **(none | {"action": -1.0}))
