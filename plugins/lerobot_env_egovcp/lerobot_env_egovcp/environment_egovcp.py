"""One simulated robot with LeRobot's names of observations."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.log.rollout_video import grey_image
from egovcp.sim.config import EnvConfig
from egovcp.sim.gym import EgovcpEnv, GymObservation


class LeRobotEgovcpEnv(gymnasium.Env[GymObservation, NDArray[np.float32]]):
    """`EgovcpEnv` for LeRobot's rollouts.

    Observation: ``images.ego_depth`` (1, 48, 64) float32 mm, 0 = invalid, and ``agent_pos`` (74,),
    which LeRobot calls ``observation.state``. ``info["is_success"]`` is true only at the end of a
    successful episode: LeRobot counts episodes in which it is ever true.
    """

    observation_space: gymnasium.Space[Any]
    action_space: gymnasium.Space[Any]

    def __init__(self, task: str, config: EnvConfig) -> None:
        self.task = self.task_description = task
        self._max_episode_steps = config.episode(task).ticks
        self._env = EgovcpEnv(task, config)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": spec.PLANNER_HZ}
        self.render_mode = "rgb_array"
        self.action_space = self._env.action_space
        shape = (1, spec.DEPTH_ROWS, spec.DEPTH_COLS)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "images.ego_depth": gymnasium.spaces.Box(0, spec.DEPTH_MAX_M * 1e3, shape),
                "agent_pos": gymnasium.spaces.Box(-np.inf, np.inf, (spec.STATE_DIM,), np.float32),
            }
        )
        self._depth: NDArray[np.uint16] = np.zeros(shape[1:], dtype=np.uint16)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[GymObservation, dict[str, Any]]:
        """Start the next episode, or episode 0 of ``seed``."""
        super().reset(seed=seed)
        observed, info = self._env.reset(seed=seed, options=options)
        return self._renamed(observed), info | {"is_success": False}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[GymObservation, float, bool, bool, dict[str, Any]]:
        """One planner tick of 40 ms."""
        observed, reward, terminated, truncated, info = self._env.step(action)
        success = bool(info["success"]) and (terminated or truncated)
        return self._renamed(observed), reward, terminated, truncated, {"is_success": success}

    def render(self) -> NDArray[np.uint8]:
        """The depth image as (192, 256, 3): near is bright, black is invalid."""
        return grey_image(self._depth / 1e3)

    def close(self) -> None:
        self._env.close()

    def _renamed(self, observed: GymObservation) -> GymObservation:
        self._depth = observed["depth"]
        return {
            "images.ego_depth": observed["depth"][None].astype(np.float32),
            "agent_pos": observed["state"],
        }
