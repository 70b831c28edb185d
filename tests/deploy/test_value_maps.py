"""The maps in the log are those of the plan, for both hands."""

from __future__ import annotations

import numpy as np
import torch

from egovcp.spec import ACTION_BOX
from egovcp_deploy.value_maps import value_maps
from tests.support.worlds import PointWorld


def test_each_hand_has_its_own_map_with_the_goal_as_its_best_point() -> None:
    world = PointWorld()
    goal = ACTION_BOX.to_normalised(np.array([0.3, 0.24, 0.1, 0.2, -0.24, 0.4, 0.74]))
    carry = world.start(torch.zeros(1, 7), torch.tensor(goal)[None])
    left, right = value_maps(world, carry, np.zeros(7, np.float32))
    assert (left.hand, right.hand) == ("left", "right")
    for found, (x, y, z) in ((left, (0.3, 0.24, 0.1)), (right, (0.2, -0.24, 0.4))):
        row, column = np.unravel_index(found.values.argmax(), found.values.shape)
        assert abs(found.x_b[column] - x) < 0.02
        assert abs(found.z_b[row] - z) < 0.02
        assert abs(found.y_b - y) < 1e-6
