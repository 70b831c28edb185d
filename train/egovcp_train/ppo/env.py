"""The simulator as rsl-rl's `VecEnv`: one tick is 40 ms, an action is the planner's."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from egovcp.reactive import Eyes, ReactiveConfig
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import Observation, VectorEnv
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_DIM


class ContactEnv(VecEnv):  # type: ignore[misc]
    """N robots, each of which begins the next episode as soon as one is over.

    Episodes count from ``first``; the tasks take turns.
    """

    def __init__(
        self,
        config: EnvConfig,
        tasks: Sequence[str],
        robots: int,
        network: ReactiveConfig,
        seed: int = 0,
        first: int = 0,
    ) -> None:
        self.env = VectorEnv(config, robots)
        self.num_envs, self.num_actions, self.device = robots, ACTION_DIM, "cpu"
        self.max_episode_length = max(config.episode(task).ticks for task in tasks)
        self.episode_length_buf = torch.zeros(robots, dtype=torch.long)
        self.cfg = asdict(config)
        self.episodes = first
        self._tasks, self._seed = tuple(tasks), seed
        self._eyes = Eyes(robots, network)
        self._returns = np.zeros(robots)
        everyone = np.ones(robots, dtype=np.bool_)
        self._see(self.env.reset(self._scenarios(robots)), everyone)

    def get_observations(self) -> TensorDict:
        """Groups ``depth`` (N, frames, 48, 64) and ``state`` (N, 74)."""
        return self._observations

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """One tick; the reward of a tick is the task's, and of nothing else."""
        result = self.env.step(actions.detach().clamp(-1.0, 1.0).numpy())
        done = result.terminated | result.truncated
        self.episode_length_buf += 1
        self._returns += result.reward
        log = self._record(done, result.success)
        observation = result.observation
        if done.any():
            rows = np.flatnonzero(done)
            observation = self.env.reset_rows(rows.tolist(), self._scenarios(len(rows)))
            self._returns[rows] = 0.0
            self.episode_length_buf[torch.from_numpy(rows)] = 0
        self._see(observation, done)
        extras = {
            "time_outs": torch.from_numpy(result.truncated & ~result.terminated),
            "log": log,
        }
        return (
            self._observations,
            torch.from_numpy(result.reward.astype(np.float32)),
            torch.from_numpy(done.astype(np.float32)),
            extras,
        )

    def close(self) -> None:
        """End the threads."""
        self.env.close()

    # --- inside ----------------------------------------------------------------------
    def _scenarios(self, count: int) -> list[Scenario]:
        """The next episodes; each task counts its own from 0."""
        found = []
        for number in range(self.episodes, self.episodes + count):
            round_, turn = divmod(number, len(self._tasks))
            found.append(Scenario(self._tasks[turn], self._seed, round_))
        self.episodes += count
        return found

    def _see(self, observation: Observation, fresh: NDArray[np.bool_]) -> None:
        groups = {
            "depth": self._eyes.look(observation.depth, fresh),
            "state": torch.from_numpy(observation.state),
        }
        self._observations = TensorDict(groups, batch_size=[self.num_envs])

    def _record(
        self, done: NDArray[np.bool_], success: NDArray[np.bool_]
    ) -> dict[str, list[float]]:
        """TASK/return, TASK/success and TASK/ticks of the episodes that have ended."""
        log: dict[str, list[float]] = defaultdict(list)
        for row in np.flatnonzero(done):
            task = self.env.instances[row].scenario.task
            log[f"{task}/return"].append(float(self._returns[row]))
            log[f"{task}/success"].append(float(success[row]))
            log[f"{task}/ticks"].append(float(self.episode_length_buf[row]))
        return log
