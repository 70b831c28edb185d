"""The value map says what the model says of the hand at each point, and of nothing else."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
import torch

from egovcp.plan.config import PlannerConfig
from egovcp.plan.value_map import HAND_AXES, HandGrid, hand_grid, value_map
from egovcp.spec import ACTION_BOX, RETURN_STEPS
from egovcp.testing import toy_model
from tests.support.worlds import PointWorld

type Hand = Literal["left", "right"]
HANDS: tuple[Hand, ...] = ("left", "right")
FREE = PlannerConfig(pose_cost=0.0)


@pytest.mark.parametrize("hand", HANDS)
def test_the_best_point_is_the_goal(hand: Hand) -> None:
    world = PointWorld()
    grid = hand_grid(hand, rows=8, columns=11)
    x, _, z = HAND_AXES[hand]
    goal = ACTION_BOX.to_metric(np.zeros(7))
    goal[x], goal[z] = grid.x[7], grid.z[2]
    carry = world.start(torch.zeros(1, 7), torch.tensor(ACTION_BOX.to_normalised(goal))[None])
    values = value_map(world, carry, torch.zeros(1, 7), hand, grid, FREE)
    assert values.shape == (1, 8, 11)
    assert np.unravel_index(int(values.argmax()), (8, 11)) == (2, 7)


@pytest.mark.parametrize("hand", HANDS)
def test_every_point_is_the_value_of_that_action(hand: Hand) -> None:
    model = toy_model()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    carry = model.initial(2)
    action = torch.rand(2, 7) * 2 - 1
    grid = HandGrid(np.array([0.1, 0.3], np.float32), np.array([-0.1, 0.0, 0.4], np.float32))
    values = value_map(model, carry, action, hand, grid, FREE)
    x, _, z = HAND_AXES[hand]
    for row in range(3):
        for column in range(2):
            metric = ACTION_BOX.to_metric(action.numpy())
            metric[:, x], metric[:, z] = grid.x[column], grid.z[row]
            moved = torch.tensor(ACTION_BOX.to_normalised(metric), dtype=torch.float32)
            with torch.no_grad():
                expected = model.value(carry, moved)
            torch.testing.assert_close(values[:, row, column], expected, rtol=1e-4, atol=1e-5)
    assert values.std() > 0


def test_the_cost_of_holding_a_pose_is_subtracted() -> None:
    model, grid = toy_model(), hand_grid("left", rows=3, columns=2)
    carry, action = model.initial(1), torch.full((1, 7), 0.5)
    config = PlannerConfig(pose_cost=0.1, action_rate_cost=7.0)
    free = value_map(model, carry, action, "left", grid, FREE)
    held = value_map(model, carry, action, "left", grid, config)
    pose = (1 + 1 + 5 * 0.25) / 7  # x and z at the ends of the box
    steps = model.discount ** torch.arange(RETURN_STEPS)
    assert (free - held)[0, 0, 0] == pytest.approx(0.1 * pose * float(steps.sum()), rel=1e-4)


def test_the_grid_spans_the_box_of_its_hand() -> None:
    grid = hand_grid("right", rows=3, columns=4)
    np.testing.assert_allclose(grid.x[[0, -1]], [ACTION_BOX.low[3], ACTION_BOX.high[3]], atol=1e-6)
    np.testing.assert_allclose(grid.z[[0, -1]], [ACTION_BOX.low[5], ACTION_BOX.high[5]], atol=1e-6)
