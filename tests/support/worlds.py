"""World models with known optimal plans, values and terminations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from egovcp import spec
from egovcp.plan import PlannerConfig


def plain_planner(**changes: Any) -> PlannerConfig:
    """A planner whose candidates are random walks without a pose cost."""
    plain = {"samples": 1024, "elites": 64, "pose_cost": 0.0, "action_rate_cost": 0.0}
    return PlannerConfig(**(plain | {"action_parameterization": "random_walk"} | changes))


class Point(NamedTuple):
    """State of `PointWorld`."""

    position: Tensor  # (..., 7)
    goal: Tensor  # (..., 7)


class PointWorld:
    """A point that jumps to each action; Q is minus the squared distance of action and goal.

    Its best plan is known: walk straight to the goal. Beyond ``cliff`` in the first
    coordinate the point has fallen.
    """

    discount = torch.tensor(spec.GAMMA)

    def __init__(self, cliff: float = np.inf, floor: float = -100.0) -> None:
        self.cliff = cliff
        self.min_return = torch.tensor(floor)

    @staticmethod
    def start(executed: Tensor, goal: Tensor) -> Point:
        """Robots at their last executed actions (E, 7), each with a goal (E, 7)."""
        return Point(executed, goal.expand_as(executed))

    def expand_candidates(self, carry: Point) -> Point:
        return Point(carry.position[:, None], carry.goal[:, None])

    def imagine(self, carry: Point, action: Tensor) -> Point:
        return Point(action, carry.goal)

    def value(self, carry: Point, action: Tensor) -> Tensor:
        return -(action - carry.goal).square().sum(-1)

    def termination(self, carry: Point) -> Tensor:
        return (carry.position[..., 0] > self.cliff).to(carry.position.dtype)


class ScriptedWorld:
    """Q, D and rewards read from a script, whatever the actions: step k has ``values[k]``,
    ``deaths[k]`` and ``rewards[k]``.

    The carry is the step, so a value or a termination asked for at the wrong time shows.
    """

    def __init__(
        self,
        values: Sequence[float],
        deaths: Sequence[float],
        floor: float = 0.0,
        rewards: Sequence[float] = (),
        gamma: float = spec.GAMMA,
    ) -> None:
        self.values, self.deaths = torch.tensor(values), torch.tensor(deaths)
        self.rewards, self.discount = torch.tensor(rewards), torch.tensor(gamma)
        self.min_return = torch.tensor(floor)

    def start(self, robots: int = 1) -> Tensor:
        """Step 0 for every robot, (E,)."""
        return torch.zeros(robots, dtype=torch.long)

    def expand_candidates(self, carry: Tensor) -> Tensor:
        return carry[:, None]

    def imagine(self, carry: Tensor, action: Tensor) -> Tensor:
        return (carry + 1).expand(action.shape[:-1])

    def value(self, carry: Tensor, action: Tensor) -> Tensor:
        return self.values[carry].expand(action.shape[:-1])

    def reward(self, carry: Tensor, action: Tensor) -> Tensor:
        return self.rewards[carry].expand(action.shape[:-1])

    def termination(self, carry: Tensor) -> Tensor:
        return self.deaths[carry]
