"""``egovcp-eval-lowlevel``: what is commanded, what is measured, what is written."""

import dataclasses
import errno
import json
import signal
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from egovcp.robot.controllers import make_controller
from egovcp.robot.g1 import EFFORT_LIMIT
from egovcp.sim.config import SensorConfig
from egovcp.spec import ACTION_BOX, ACTION_ETA, ACTION_RATE_LIMIT, JOINT_NAMES
from egovcp_train.lowlevel import evaluate, skills, trial
from egovcp_train.lowlevel.config import DisturbanceConfig
from egovcp_train.lowlevel.evaluate import main
from egovcp_train.lowlevel.skills import SKILLS, Skill
from egovcp_train.lowlevel.trial import (
    _directions,
    _lag,
    _rotation,
    _torque_rms,
    _velocity_error,
    play,
)


def _rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize("skill", SKILLS, ids=lambda s: s.name)
def test_every_skill_commands_what_its_line_says(skill: Skill):
    commands = skill.script(skill.ticks, 16, _rng())
    assert commands.shape == (skill.ticks, 16, 10)
    hands = ACTION_BOX.to_normalised(commands[..., 3:])[..., :6]
    assert (np.abs(hands) <= 1 + 1e-9).all()
    walks = skill.name in ("walk", "backward", "sideways", "turning", "crouch", "low")
    assert commands[..., :3].any() == walks
    ranges = {
        "squat": (0.50, 0.74),
        "walk": (0.70, 0.74),
        "crouch": (0.58, 0.62),
        "low": (0.55, 0.55),
    }
    if skill.name in ranges:
        low, high = ranges[skill.name]
        assert low - 1e-9 <= commands[-1, :, -1].min() <= commands[-1, :, -1].max() <= high + 1e-9


def test_the_random_walk_is_that_of_the_data():
    actions = ACTION_BOX.to_normalised(skills.random_walk(1000, 8, _rng())[..., 3:])
    steps = np.abs(np.diff(actions[::2], axis=0))
    assert steps.max() <= ACTION_ETA + 1e-9
    assert np.abs(actions).max() <= 1 + 1e-9
    assert actions.std() > 0.4  # it visits the whole box
    np.testing.assert_allclose(actions[::2], actions[1::2])


def test_the_lag_of_a_delayed_copy_is_its_delay():
    targets = np.cumsum(_rng().standard_normal((200, 3, 2, 3)), axis=0)
    hands = np.concatenate([np.repeat(targets[:1], 7, axis=0), targets[:-7]])
    assert _lag(hands, targets, np.ones((200, 3), dtype=bool)) == pytest.approx(7 / 50)


def test_swinging_with_each_step_is_no_velocity_error_but_being_slow_is():
    time = np.arange(200) / 50
    wanted = np.tile([0.4, 0.0], (200, 2, 1))
    velocity = wanted.copy()
    velocity[:, 0, 1] = 0.2 * np.sin(2 * np.pi * time / 0.8)
    velocity[:, 1, 0] = 0.3
    error = _velocity_error(velocity, wanted, np.ones((200, 2), dtype=bool))
    assert error == pytest.approx([0.0, 0.1], abs=1e-6)


@pytest.mark.parametrize(
    ("name", "axis", "speeds"),
    [("backward", 0, {-0.3}), ("sideways", 1, {-0.2, 0.2}), ("turning", 2, {-0.6, 0.6})],
)
def test_skills_in_other_directions_have_one_velocity(name: str, axis: int, speeds: set[float]):
    (skill,) = [s for s in SKILLS if s.name == name]
    velocity = skill.script(skill.ticks, 32, _rng())[-1, :, :3]
    assert set(np.round(velocity[:, axis], 9)) == speeds
    assert not np.delete(velocity, axis, axis=1).any()


def test_seldom_steps_are_far_at_the_rate_limit_and_then_held():
    hands = ACTION_BOX.to_normalised(skills.held_walk(1000, 8, _rng())[..., 3:])[..., :6]
    step = np.abs(np.diff(hands[::2], axis=0))
    assert step.max() == pytest.approx(ACTION_RATE_LIMIT)
    assert 0.5 < (step.max(axis=2) < 1e-9).mean() < 0.9


def test_the_cameras_rotation_is_that_of_the_torso_between_planner_ticks():
    yaw = 0.01 * np.arange(20)[:, None] * [1.0, 0.0]  # rad, robot 1 stays
    torso = Rotation.from_euler("z", yaw.reshape(-1, 1)).as_matrix().reshape(20, 2, 3, 3)
    counted = np.ones((20, 2), dtype=bool)
    counted[15:, 0] = False
    torso[15:, 0] = 0.0  # of a simulation that diverged
    for apart in (1, 8):
        found = _rotation(torso, counted, apart)
        np.testing.assert_allclose(found, [[0, 0.433 * apart, 0], [0, 0, 0]], atol=1e-3)


def test_the_rms_torque_counts_only_the_ticks_before_a_fall():
    torque = np.zeros((4, 2, 29))
    torque[:, 0] = 0.5 * EFFORT_LIMIT
    torque[:2, 1] = np.array([3.0, 4.0])[:, None] / 10.0 * EFFORT_LIMIT
    torque[2:, 1] = np.nan
    counted = np.ones((4, 2), dtype=bool)
    counted[2:, 1] = False
    np.testing.assert_allclose(_torque_rms(torque, counted)[0], 0.5)
    np.testing.assert_allclose(_torque_rms(torque, counted)[1], np.sqrt(12.5) / 10.0)
    assert np.isnan(_torque_rms(torque, np.zeros((4, 2), dtype=bool))).all()


def test_a_push_along_the_heading_goes_forwards_or_backwards():
    skill = Skill("trial", "", 1.0, skills.neutral, push=1.0, push_any_direction=False)
    assert set(_directions(skill, 32, _rng())) == {0.0, np.pi}


def _play(script: str, seconds: float, **options: float):
    skill = Skill("trial", "", seconds, getattr(skills, script), **options)
    return play(make_controller("stance"), skill, 4, 0, DisturbanceConfig(models=4), SensorConfig())


def test_the_stance_law_stands_and_reaches():
    outcome = _play("held_targets", 2.4, settled_only=True)
    assert outcome.survived.all()
    assert (outcome.hand_error_m < 0.03).all()
    assert (outcome.height_error_m < 0.02).all()
    assert np.isnan(outcome.velocity_error_mps).all()
    assert np.isnan(outcome.turning_error_radps).all()
    assert outcome.camera_px_per_step.shape == (4, 3)
    assert (outcome.camera_px_per_step < outcome.camera_px_8_steps).all()


def test_a_robot_that_is_thrown_down_has_fallen():
    outcome = _play("neutral", 3.0, push=2.0)
    assert not outcome.survived.any()


def test_stepping_is_the_share_of_the_ticks_up_to_a_fall_in_which_it_steps():
    walk = Skill("trial", "", 2.0, skills.walking((0.3, 0.3), (0.72, 0.72)))
    stand = Skill("trial", "", 2.0, skills.neutral)
    physics, sensors = DisturbanceConfig(models=4), SensorConfig()
    for name, skill, low, high in (
        ("walk", walk, 0.9, 1.0),  # not yet while the velocity rises
        ("walk", stand, 0.0, 0.1),
        ("stance", walk, 0.0, 0.0),
    ):
        share = play(make_controller(name), skill, 4, 0, physics, sensors).stepping_share
        assert ((low <= share) & (share <= high)).all(), (name, share)


def test_it_writes_a_line_per_skill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("HOME", str(tmp_path))
    flags = ["--output_dir=~/out", "--skills=squat, squat", "--episodes=2", "--threads=1"]
    assert main(flags) == 0
    figures = json.loads((tmp_path / "out" / "lowlevel.json").read_text())
    assert figures["squat"]["episodes"] == 2
    assert figures["squat"]["survival"] == 1.0
    assert figures["squat"]["height_error_m"] < 0.02
    assert figures["squat"]["velocity_error_mps"] is None
    assert figures["squat"]["stepping_share"] == 0.0
    assert len(figures["squat"]["camera_px_per_step"]) == 3
    assert len(figures["squat"]["camera_px_8_steps"]) == 3
    torques = figures["squat"]["torque_rms_relative"]
    assert list(torques) == list(JOINT_NAMES)
    hottest = max(torques, key=torques.get)
    assert 0.02 < torques[hottest] < 0.5
    assert figures["_run"]["controller"] == make_controller("walk").id
    out, err = capsys.readouterr()
    assert "2/2" in err  # each skill once
    assert "squat" in out
    assert hottest.removesuffix("_joint").removeprefix("left_").removeprefix("right_") in out
    rows = out[out.index("skill") : out.index("metrics:")].splitlines()
    assert max(len(row) for row in rows) <= 120


def test_an_interrupted_evaluation_keeps_the_skills_that_were_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    original = trial.play

    def interrupted(controller, skill, *args, **options):
        if skill.name == "reach":
            signal.raise_signal(signal.SIGINT)
        return original(controller, skill, *args, **options)

    monkeypatch.setattr(trial, "play", interrupted)
    flags = [f"--output_dir={tmp_path}", "--skills=push,reach", "--episodes=2", "--threads=1"]
    assert main(flags) == 130
    figures = json.loads((tmp_path / "lowlevel.json").read_text())
    assert set(figures) == {"push", "_run"}
    assert figures["push"]["episodes"] == 2
    assert figures["_run"]["complete"] is False
    assert "INCOMPLETE: push 2 of 2, reach 0 of 2 robots" in capsys.readouterr().out


def test_an_interrupted_skill_counts_the_batches_that_were_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    original, seeds = trial.play, []

    def interrupted(controller, skill, robots, seed, *args, **options):
        seeds.append(seed)
        if len(seeds) == 2:
            signal.raise_signal(signal.SIGINT)
        return original(controller, skill, robots, seed, *args, **options)

    monkeypatch.setattr(trial, "play", interrupted)
    monkeypatch.setattr(evaluate, "_BATCH", 2)
    flags = [f"--output_dir={tmp_path}", "--skills=push", "--episodes=5", "--threads=1"]
    assert main(flags) == 130
    push = json.loads((tmp_path / "lowlevel.json").read_text())["push"]
    assert (push["incomplete"], push["episodes"], push["episodes_requested"]) == (True, 2, 5)


def test_a_diverging_simulation_is_an_error_and_writes_no_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(trial, "MAX_SPEED", 1e-3)
    flags = [f"--output_dir={tmp_path}", "--skills=squat", "--episodes=2", "--threads=1"]
    assert main(flags) == 3
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert "the simulation diverged in skill squat, seed 1000, tick 0, robot 0" in message
    assert list(tmp_path.iterdir()) == []


def test_the_json_is_written_before_the_table_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def fail(_: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(evaluate, "_play_all", lambda config, skills, out: out.update(squat={}))
    monkeypatch.setattr(evaluate, "table", str)
    monkeypatch.setattr(evaluate, "echo", fail)
    with pytest.raises(OSError, match="No space left"):
        evaluate.evaluate(evaluate.LowLevelEvalConfig(str(tmp_path), skills="squat"))
    assert "squat" in json.loads((tmp_path / "lowlevel.json").read_text())


def test_a_folder_in_the_place_of_the_json_is_refused_before_any_robot_plays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "lowlevel.json").mkdir()
    assert main([f"--output_dir={tmp_path}"]) == 2
    assert "lowlevel.json cannot be a file: found a folder" in capsys.readouterr().err


def test_an_empty_output_folder_is_refused(capsys: pytest.CaptureFixture[str]):
    assert main(["--output_dir="]) == 2
    assert "--output_dir is empty" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flag", "code", "message"),
    [
        ("--skills=squad", 2, "did you mean 'squat'"),
        ("--episodes=0", 2, "--episodes"),
        ("--disturbances.mass_scale=[0.9,100]", 2, "at least 0.5 and at most 2"),
        ("--controller=stans", 2, "expected stance"),
        ("--controller=none.safetensors", 4, "no such controller"),
    ],
)
def test_bad_options_are_refused(tmp_path, capsys, flag, code, message):
    assert main([f"--output_dir={tmp_path / 'out'}", flag]) == code
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_videos_show_the_first_robot_of_each_skill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    short = dataclasses.replace(next(s for s in SKILLS if s.name == "turning"), seconds=0.4)
    monkeypatch.setattr("egovcp_train.lowlevel.evaluate.SKILLS", (short,))
    out = tmp_path / "out"
    flags = [f"--output_dir={out}", "--skills=turning", "--episodes=2", "--videos=true"]
    assert main(flags) == 0
    with Image.open(out / "turning.gif") as image:
        assert image.n_frames == 5
        assert np.asarray(image.convert("L")).std() > 10
    assert (out / "turning.rrd").stat().st_size > 10_000
    assert main(flags) == 2
    assert f"{out / 'turning.gif'} exists" in capsys.readouterr().err
