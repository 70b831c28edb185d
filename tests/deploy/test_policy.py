"""Names of planner backends, and value maps for the log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from egovcp.artifact import load_artifact
from egovcp.plan.config import BackendName, PlannerConfig
from egovcp.spec import ACTION_BOX
from egovcp_deploy.pilot.planner import backend_of, value_maps
from tests.support.worlds import PointWorld


@pytest.mark.parametrize("backend", ["eager", "float32"])
def test_a_requested_backend_is_named(artifact_dir: Path, backend: BackendName) -> None:
    artifact = load_artifact(str(artifact_dir))
    artifact = replace(artifact, planner=replace(artifact.planner, backend=backend))
    assert backend_of(artifact.make_policy(1, 0)) == backend


def test_auto_resolves_to_a_known_name(artifact_dir: Path) -> None:
    assert backend_of(load_artifact(str(artifact_dir)).make_policy(1, 0)) in ("int8", "float32")


def test_each_hand_has_its_own_map_with_the_goal_as_its_best_point() -> None:
    world = PointWorld()
    goal = ACTION_BOX.to_normalised(np.array([0.3, 0.24, 0.1, 0.2, -0.24, 0.4, 0.74]))
    carry = world.start(torch.zeros(1, 7), torch.tensor(goal)[None])
    left, right = value_maps(world, carry, np.zeros(7, np.float32), PlannerConfig(pose_cost=0.0))
    assert (left.hand, right.hand) == ("left", "right")
    for found, (x, y, z) in ((left, (0.3, 0.24, 0.1)), (right, (0.2, -0.24, 0.4))):
        row, column = np.unravel_index(found.values.argmax(), found.values.shape)
        assert abs(found.x_b[column] - x) < 0.02
        assert abs(found.z_b[row] - z) < 0.02
        assert abs(found.y_b - y) < 1e-6
