"""An untrained policy and short episodes, so that whole commands run in seconds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from egovcp.artifact import save_artifact
from egovcp.model import PRESETS
from egovcp.plan import PlannerConfig
from egovcp.robot.stance import StanceController
from egovcp.testing import toy_model


@pytest.fixture(scope="session")
def artifact_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy artifact for the simulated robot, with random weights and a tiny planner."""
    path = tmp_path_factory.mktemp("policy") / "policy"
    save_artifact(path, toy_model(), _PLANNER, {"controller_id": StanceController().id})
    return path


@pytest.fixture(scope="session")
def foreign_artifact_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same for a robot with another low-level controller."""
    path = tmp_path_factory.mktemp("foreign") / "policy"
    save_artifact(path, toy_model(), _PLANNER, {"controller_id": "another-controller"})
    return path


@pytest.fixture(scope="session")
def earning_artifact_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with a world model that foresees rewards."""
    path = tmp_path_factory.mktemp("earning") / "policy"
    loss = replace(PRESETS["debug"].loss, reward=1.0)
    model = toy_model(replace(PRESETS["debug"], loss=loss))
    save_artifact(path, model, _PLANNER, {"controller_id": StanceController().id})
    return path


@pytest.fixture
def short() -> list[str]:
    """Flags that make ball episodes 15 ticks long with the throw at tick 3."""
    return [
        "--env.controller=stance",
        "--env.ball_episode.ticks=15",
        "--env.ball_episode.event_ticks=[3,3]",
    ]


#: Of random weights any step is good; short ones leave the robot standing, so that what is tested
#: is what surrounds the planner.
_PLANNER = PlannerConfig(samples=16, horizon=3, iterations=2, elites=4, eta=0.004)
