"""Gymnasium environment of one simulated robot: ``gymnasium.make("egovcp/ball-v0")``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from egovcp.sim import config as sim_config
from egovcp.sim.base_env import Observation
from egovcp.sim.robot_env import make_env
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.registry import find_task, task_names

GymObservation = dict[str, NDArray[Any]]


class EgovcpEnv(gymnasium.Env[GymObservation, NDArray[np.float32]]):
    """One robot in one task.

    Shapes and rate are those of the robot of the task. Observation: ``depth`` (H, W) uint16 mm,
    0 invalid, and ``state`` (S,) float32. Action: (A,) in [-1, 1]. ``info`` holds ``success``,
    ``sent_action`` and ``reward_terms``.
    ``reset(seed=n)`` starts episode 0 of seed n, ``reset()`` the next episode of the seed.
    """

    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]

    def __init__(self, task: str, config: sim_config.EnvConfig | None = None) -> None:
        self._next = Scenario(task, 0, 0)
        options = config or sim_config.EnvConfig()
        robot = find_task(task).robot_spec()
        self.metadata = {"render_modes": [], "render_fps": robot.planner_hz}
        self._env = make_env(options, 1, [task])
        most = round(1000 * robot.depth_max_m)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "depth": gymnasium.spaces.Box(0, most, robot.depth, np.uint16),
                "state": gymnasium.spaces.Box(-np.inf, np.inf, (robot.state_dim,), np.float32),
            }
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (robot.action_dim,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[GymObservation, dict[str, Any]]:
        """Start the next episode, or episode 0 of ``seed``."""
        super().reset(seed=seed)
        task = self._next.task
        scenario = self._next if seed is None else Scenario(task, seed, 0)
        self._next = Scenario(task, scenario.seed, scenario.episode + 1)
        return _first_row(self._env.reset([scenario])), {"episode": scenario.episode}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[GymObservation, float, bool, bool, dict[str, Any]]:
        """One planner tick; 40 ms of the G1."""
        result = self._env.step(np.asarray(action)[None])
        info = {
            "success": bool(result.success[0]),
            "sent_action": result.sent_action[0],
            "reward_terms": {name: float(v[0]) for name, v in result.reward_terms.items()},
        }
        return (
            _first_row(result.observation),
            float(result.reward[0]),
            bool(result.terminated[0]),
            bool(result.truncated[0]),
            info,
        )

    def close(self) -> None:
        """End the threads of the simulation."""
        self._env.close()


def _first_row(observation: Observation) -> GymObservation:
    return {"depth": observation.depth[0], "state": observation.state[0]}


def register() -> None:
    """Register ``egovcp/<task>-v0`` for every installed task of which datasets can be collected, so
    not for ``sequence``; safe to call twice."""
    for task in task_names(training=True):
        name = f"egovcp/{task}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point="egovcp.sim.gym:EgovcpEnv", kwargs={"task": task})
