"""RMS torques, and torques at rest against what gravity needs."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from egovcp.robot.controllers import make_controller
from egovcp.robot.g1 import EFFORT_LIMIT
from egovcp.robot.stance import StanceController
from egovcp.robot.stance_table import standing_pose
from egovcp.spec import ACTION_BOX, JOINT_NAMES
from egovcp_train.lowlevel.evaluate import main
from egovcp_train.lowlevel.physics import compile_model
from egovcp_train.lowlevel.torque import StandingLoad, relative_rms, standing_load, static_torque

KNEE = JOINT_NAMES.index("left_knee_joint")
HIP_ROLLS = [JOINT_NAMES.index(f"{side}_hip_roll_joint") for side in ("left", "right")]


def test_relative_rms_counts_only_the_ticks_before_a_fall():
    torque = np.zeros((4, 2, 29))
    torque[:, 0] = 0.5 * EFFORT_LIMIT
    torque[:2, 1] = np.array([3.0, 4.0])[:, None] / 10.0 * EFFORT_LIMIT
    torque[2:, 1] = np.nan
    counted = np.ones((4, 2), dtype=bool)
    counted[2:, 1] = False
    np.testing.assert_allclose(relative_rms(torque, counted)[0], 0.5)
    np.testing.assert_allclose(relative_rms(torque, counted)[1], np.sqrt(12.5) / 10.0)
    assert np.isnan(relative_rms(torque, np.zeros((4, 2), dtype=bool))).all()


def neutral_qpos() -> np.ndarray:
    pose = standing_pose(ACTION_BOX.neutral[-1])
    return np.concatenate([pose.position, pose.quaternion, pose.joints])


def test_the_static_torque_holds_the_robot_at_rest():
    model = compile_model("stock")
    torque = static_torque(model, neutral_qpos())
    data = mujoco.MjData(model)
    data.qpos[:] = neutral_qpos()
    kp = model.actuator_gainprm[:, 0]
    data.ctrl[:] = data.qpos[7:] + torque / kp  # servos that apply it at this pose
    for _ in range(100):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos[7:] - neutral_qpos()[7:]).max() < 0.02
    assert data.qpos[2] == pytest.approx(neutral_qpos()[2], abs=0.005)
    assert 5.0 < abs(torque[KNEE]) < 25.0  # the knees are bent


def test_the_stance_controller_loads_no_joint_by_more_than_gravity_needs():
    load = standing_load(make_controller("stance"), seconds=3.0)
    assert (load.excess <= 0.0).all()
    np.testing.assert_allclose(load.mean[KNEE], load.needed[KNEE], rtol=0.1)


class Squeezing(StanceController):
    """Presses the feet against each other: both hips roll inwards."""

    def step(self, state):
        target = super().step(state)
        target[:, HIP_ROLLS] += np.array([-0.08, 0.08])
        return target


def test_feet_that_press_against_each_other_exceed_the_bar():
    load = standing_load(Squeezing(), seconds=3.0)
    assert (load.excess[HIP_ROLLS] > 0.0).all()
    assert load.excess[KNEE] <= 0.0


def test_the_bar_is_a_fifth_above_the_need_and_a_hundredth_of_the_peak():
    needed = 0.1 * EFFORT_LIMIT
    just = StandingLoad(1.2 * needed + 0.0099 * EFFORT_LIMIT, needed)
    beyond = StandingLoad(-1.2 * needed - 0.0101 * EFFORT_LIMIT, needed)
    assert (just.excess <= 0.0).all()
    assert (beyond.excess > 0.0).all()


def test_lowlevel_json_has_the_torque_of_every_joint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    quick = standing_load(make_controller("stance"), seconds=1.0)
    monkeypatch.setattr("egovcp_train.lowlevel.torque.standing_load", lambda *_: quick)
    from egovcp_train.lowlevel import skills

    short = skills.Skill("rest", "1 s at the neutral pose", 1.0, skills.neutral)
    monkeypatch.setattr("egovcp_train.lowlevel.evaluate.SKILLS", (short,))
    assert main([f"--output_dir={tmp_path / 'out'}", "--skills=rest", "--episodes=2"]) == 0
    figures = json.loads((tmp_path / "out" / "lowlevel.json").read_text())
    torques = figures["rest"]["torque_rms_relative"]
    assert list(torques) == list(JOINT_NAMES)
    hottest = max(torques, key=torques.get)
    assert 0.02 < torques[hottest] < 0.5
    load = figures["_standing_load"]
    assert load["joints"]["left_knee_joint"]["needed_nm"] == pytest.approx(quick.needed[KNEE])
    assert load["within_bar"] == bool((quick.excess <= 0).all())
    words = capsys.readouterr().out
    assert hottest.removesuffix("_joint").removeprefix("left_").removeprefix("right_") in words
    assert "gravity needs" in words
