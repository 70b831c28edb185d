"""Return and success of the planner in simulation during training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import batched
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import UsageError
from egovcp.model import WorldModel
from egovcp.plan import PlannerConfig
from egovcp.plan.policy import Policy
from egovcp.sim.scenario import VALIDATION, Scenario

if TYPE_CHECKING:
    from egovcp.sim.base_env import BaseVectorEnv

ROBOTS: Final = 8  # side by side

type Outcome = tuple[NDArray[np.float64], NDArray[np.bool_]]
"""Return and success (B,) of the episodes played side by side."""


class ClosedLoop:
    """Plays the same scenarios of each task with any model."""

    def __init__(self, tasks: Sequence[str], episodes: int, seed: int, controller_id: str) -> None:
        """Raises `UsageError` unless ``controller_id`` is that of a controller of egovcp; for tasks
        of another robot than the G1 it is ignored."""
        self._controller = _controller_name(controller_id, tasks)
        self._tasks, self._episodes, self._seed = tuple(tasks), episodes, seed

    def play(self, model: WorldModel, planner: PlannerConfig) -> dict[str, float]:
        """``TASK/return``, the mean sum of rewards, and ``TASK/success``, a share."""
        metrics: dict[str, float] = {}
        for task in self._tasks:
            scenarios = [Scenario(task, VALIDATION + self._seed, i) for i in range(self._episodes)]
            outcomes = [
                self._play_side_by_side(model, planner, part) for part in batched(scenarios, ROBOTS)
            ]
            returns, successes = (np.concatenate(x) for x in zip(*outcomes, strict=True))
            metrics[f"{task}/return"] = float(returns.mean())
            metrics[f"{task}/success"] = float(successes.mean())
        return metrics

    def _play_side_by_side(
        self, model: WorldModel, planner: PlannerConfig, scenarios: Sequence[Scenario]
    ) -> Outcome:
        from egovcp.sim.config import evaluation_config
        from egovcp.sim.robot_env import make_env

        config = replace(evaluation_config(), controller=self._controller)
        env = make_env(config, len(scenarios), [scenario.task for scenario in scenarios])
        return _play(env, Policy(model, planner, len(scenarios), self._seed), scenarios)


def _play(env: BaseVectorEnv, policy: Policy, scenarios: Sequence[Scenario]) -> Outcome:
    """Play one episode per row."""
    observation = env.reset(scenarios)
    returns = np.zeros(len(scenarios))
    success: NDArray[np.bool_] = np.zeros(len(scenarios), dtype=np.bool_)
    while not env.done.all():
        live = ~env.done
        result = env.step(policy.act(observation.depth, observation.state).action)
        policy.advance(result.sent_action)
        returns += np.where(live, result.reward, 0.0)
        observation, success = result.observation, result.success
    return returns, success


def _controller_name(controller_id: str, tasks: Sequence[str]) -> str:
    """The name of the shipped controller of the G1 with this id; another robot has its own, and
    ignores the name."""
    from egovcp.robot.controllers import STANCE, WALK, make_controller
    from egovcp.sim.base_env import one_robot

    if not one_robot(tasks).is_g1:
        return WALK
    ids = {make_controller(name).id: name for name in (STANCE, WALK)}
    if controller_id not in ids:
        raise UsageError(
            f"--eval_closed_loop: the data was collected with the controller {controller_id!r}, "
            f"expected one of {', '.join(ids)}; train without the option, and evaluate with "
            "egovcp-eval --env.controller=FILE"
        )
    return ids[controller_id]
