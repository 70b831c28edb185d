"""J of the planned action with one hand moved over its x-z plane (fig. 7a).

    J(z, x) = Q(h_t, z_t, a') - C(a'),  a' = a with its hand at (x, z)

with a the planned action and C the planner's cost of holding a pose; Q does not contain it. Q was
fitted to actions that the rate limit allows after the last one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp.plan.config import PlannerConfig
from egovcp.plan.objective import Dynamics
from egovcp.plan.search import action_costs
from egovcp.spec import ACTION_BOX

#: Where x, y and z of each hand are in an action.
HAND_AXES: Final = {"left": (0, 1, 2), "right": (3, 4, 5)}


class HandGrid(NamedTuple):
    """Hand targets in the pelvis heading frame, m, ascending."""

    x: NDArray[np.float32]  # (m,) forward
    z: NDArray[np.float32]  # (n,) up


def hand_grid(hand: Literal["left", "right"], rows: int = 24, columns: int = 24) -> HandGrid:
    """The whole action box of a hand."""
    x, _, z = HAND_AXES[hand]
    low, high = ACTION_BOX.low, ACTION_BOX.high
    return HandGrid(
        np.linspace(low[x], high[x], columns, dtype=np.float32),
        np.linspace(low[z], high[z], rows, dtype=np.float32),
    )


@torch.no_grad()
def value_map[L](
    model: Dynamics[L],
    carry: L,
    action: Tensor,
    hand: Literal["left", "right"],
    grid: HandGrid,
    planner: PlannerConfig,
) -> Tensor:
    """`held_value` (E, n, m) of action (E, 7) with its ``hand`` at each (z, x) of ``grid``, return
    units."""
    axis_x, _, axis_z = HAND_AXES[hand]
    x = _normalised(grid.x, axis_x, action)
    z = _normalised(grid.z, axis_z, action)
    actions = action[:, None, None, :].repeat(1, len(z), len(x), 1)  # (E, n, m, 7)
    actions[..., axis_x] = x
    actions[..., axis_z] = z[:, None]
    values = held_value(model, carry, actions.flatten(1, 2), planner)
    return values.reshape(len(action), len(z), len(x))


@torch.no_grad()
def held_value[L](model: Dynamics[L], carry: L, actions: Tensor, planner: PlannerConfig) -> Tensor:
    """J (E, M) of actions (E, M, 7), return units: Q minus the planner's cost of holding that pose,
    without the cost of changing to it."""
    held = replace(planner, action_rate_cost=0.0)
    costs = action_costs(actions[:, 0, None], actions[..., None, :], held, model.discount)
    return model.value(model.expand_candidates(carry), actions) - costs


def _normalised(metric: NDArray[np.float32], axis: int, like: Tensor) -> Tensor:
    """Values of one axis, m -> normalised action units."""
    rows = np.tile(np.asarray(ACTION_BOX.neutral), (len(metric), 1))
    rows[:, axis] = metric
    return torch.as_tensor(ACTION_BOX.to_normalised(rows)[:, axis], dtype=like.dtype).to(
        like.device
    )
