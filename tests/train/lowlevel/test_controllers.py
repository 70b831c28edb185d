"""The gait without a policy, and the controller that the package ships."""

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open

from egovcp.robot.controllers import make_controller
from egovcp.robot.walk_policy import WalkPolicy
from egovcp.robot.walking import ACTIONS, OBSERVATION_DIM, WalkConfig, WalkingController
from egovcp.sim.config import SensorConfig
from egovcp_train.lowlevel.config import DisturbanceConfig
from egovcp_train.lowlevel.skills import SKILLS, Skill, walking
from egovcp_train.lowlevel.trial import SkillOutcome, play


# --- the gait without a policy --------------------------------------------------------
def no_residual() -> WalkPolicy:
    """A policy of action 0, which leaves everything to stance law and gait."""
    zeros, ones = np.zeros(OBSERVATION_DIM, np.float32), np.ones(OBSERVATION_DIM, np.float32)
    bias = np.zeros(ACTIONS, np.float32)
    return WalkPolicy(zeros, ones, ((np.outer(bias, zeros), bias),), WalkConfig(), {})


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
)
def test_robots_of_randomised_physics_are_still_up_and_walking_after_two_seconds(seed: int):
    skill = Skill("alone", "", 2.0, walking((0.1, 0.6), (0.70, 0.74)))
    physics, sensors = DisturbanceConfig(models=16), SensorConfig()
    outcome = play(WalkingController(no_residual()), skill, 16, seed, physics, sensors, "points")
    assert outcome.survived.mean() > 0.7
    assert outcome.stepping_share.min() > 0.6


# --- the shipped controller -----------------------------------------------------------
ROOT = Path(__file__).resolve().parents[3]
SHIPPED = ROOT / "egovcp/robot/g1_walk.safetensors"


def test_the_shipped_file_is_small_and_records_its_training():
    assert SHIPPED.stat().st_size <= 2_000_000
    with safe_open(SHIPPED, framework="numpy") as file:
        content = json.loads(file.metadata()["content"])
    origin = content["provenance"]
    assert origin["steps"] > 5_000_000
    assert "seed" in origin
    commands = [stage["command"] for stage in origin["stages"]]
    assert all(command.startswith("egovcp-train-lowlevel ") for command in commands)
    assert set(content["config"]) >= {"balance", "reach", "gait"}


def test_it_walks_and_the_stance_law_does_not():
    assert make_controller("walk").walks
    assert make_controller("walk").id == "g1-walk-ppo-2d435e8f"  # datasets carry it
    assert not make_controller("stance").walks


def _short(name: str, seconds: float) -> SkillOutcome:
    (skill,) = [s for s in SKILLS if s.name == name]
    short = Skill(**{**vars(skill), "seconds": seconds})
    return play(make_controller("walk"), short, 8, 3, DisturbanceConfig(models=8), SensorConfig())


@pytest.mark.parametrize("name", ["walk", pytest.param("crouch", marks=pytest.mark.slow), "push"])
def test_on_stock_feet_and_randomised_physics_it_stays_up(name):
    """Short and few; docs/lowlevel.md has the table of 400 robots each."""
    outcome = _short(name, 4.0)
    assert outcome.survived.all()
    if name != "push":
        assert np.nanmean(outcome.velocity_error_mps) < 0.1
