"""An untrained policy for the simulated robot, in short scenes."""

from __future__ import annotations

from pathlib import Path

import pytest

from egovcp.artifact import save_artifact
from egovcp.plan import PlannerConfig
from egovcp.robot.controllers import WALK, make_controller
from egovcp.testing import toy_model


@pytest.fixture(scope="session")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy artifact with random weights and a tiny planner."""
    path = tmp_path_factory.mktemp("policy") / "policy"
    planner = PlannerConfig(samples=16, horizon=2, iterations=1, elites=4)
    provenance = {
        "controller_id": make_controller(WALK).id,
        "train_config": {"returns": {"gamma": 0.97, "steps": 8}},
    }
    save_artifact(path, toy_model(), planner, provenance)
    return path


@pytest.fixture
def flags(policy: Path, tmp_path: Path) -> list[str]:
    """Two scenes of 32 ticks, in which the event comes at tick 4; the result goes to ``out``."""
    scenes = [
        f"--env.{task}_episode.{value}"
        for task in ("ball", "wall", "arch")
        for value in ("ticks=32", "event_ticks=[4,4]", "empty_probability=0")
    ]
    return [
        f"--policy.path={policy}",
        f"--output_dir={tmp_path / 'out'}",
        "--episodes=2",
        *scenes,
    ]
