"""What the policy learns around: the gait walks for a while by itself."""

import numpy as np
import pytest

from egovcp.robot.walking import ACTIONS, WalkConfig, WalkingController
from egovcp.sim.config import SensorConfig
from egovcp_train.lowlevel.skills import Skill, walking
from egovcp_train.lowlevel.task import DisturbanceConfig
from egovcp_train.lowlevel.trial import play


class NoResidual:
    """A policy that leaves everything to what surrounds it."""

    config = WalkConfig()
    digest = "none"

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        return np.zeros((len(observation), ACTIONS), np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_robots_of_randomised_physics_are_still_up_and_walking_after_two_seconds(seed: int):
    skill = Skill("alone", "", 2.0, walking((0.1, 0.6), (0.70, 0.74)))
    physics, sensors = DisturbanceConfig(models=16), SensorConfig()
    outcome = play(WalkingController(NoResidual()), skill, 16, seed, physics, sensors, "points")
    assert outcome.survived.mean() > 0.7
    assert outcome.stepping.min() > 0.6
