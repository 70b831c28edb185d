"""rsl-rl `VecEnv` wrapper of the simulator, and a PPO learner.

One step is 40 ms; actions are those of the planner.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import nn

from egovcp.reactive import KERNELS, STRIDES, FrameStack, ReactiveConfig, ReactiveNetwork
from egovcp.sim.base_env import Observation
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import VectorEnv
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_DIM
from egovcp_train.on_policy import Log, OnPolicyLearner, rsl_rl_config

if TYPE_CHECKING:
    from egovcp_train.ppo.train import PpoTrainConfig


class ContactEnv(VecEnv):  # type: ignore[misc]
    """N robots, each of which begins the next episode as soon as one is over.

    Episode n from ``first_episode`` on is the scenario n // T of task n % T, of T tasks.
    """

    def __init__(
        self,
        config: EnvConfig,
        tasks: Sequence[str],
        robots: int,
        network: ReactiveConfig,
        seed: int = 0,
        first_episode: int = 0,
    ) -> None:
        self.env = VectorEnv(config, robots)
        self.num_envs, self.num_actions, self.device = robots, ACTION_DIM, "cpu"
        self.max_episode_length = max(config.episode(task).ticks for task in tasks)
        self.episode_length_buf = torch.zeros(robots, dtype=torch.long)
        self.cfg = asdict(config)
        self.episodes = first_episode
        self._tasks, self._seed = tuple(tasks), seed
        self._frames = FrameStack(robots, network)
        self._returns = np.zeros(robots)
        self._observe(self.env.reset(self._scenarios(robots)), np.ones(robots, dtype=np.bool_))

    def get_observations(self) -> TensorDict:
        """Groups ``depth`` (N, frames, 48, 64) and ``state`` (N, 74)."""
        return self._observations

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """One tick; the reward has no shaping terms."""
        result = self.env.step(actions.detach().clamp(-1.0, 1.0).numpy())
        done = result.terminated | result.truncated
        self.episode_length_buf += 1
        self._returns += result.reward
        log = self._log_finished(done, result.success)
        observation = result.observation
        if done.any():
            rows = np.flatnonzero(done)
            observation = self.env.reset_rows(rows.tolist(), self._scenarios(len(rows)))
            self._returns[rows] = 0.0
            self.episode_length_buf[torch.from_numpy(rows)] = 0
        self._observe(observation, done)
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
        """Stop the threads of the simulator."""
        self.env.close()

    def _scenarios(self, count: int) -> list[Scenario]:
        """Scenarios of the next episodes."""
        found = []
        for number in range(self.episodes, self.episodes + count):
            task_episode, task = divmod(number, len(self._tasks))
            found.append(Scenario(self._tasks[task], self._seed, task_episode))
        self.episodes += count
        return found

    def _observe(self, observation: Observation, reset_mask: NDArray[np.bool_]) -> None:
        groups = {
            "depth": self._frames.push(observation.depth, reset_mask),
            "state": torch.from_numpy(observation.state),
        }
        self._observations = TensorDict(groups, batch_size=[self.num_envs])

    def _log_finished(self, done: NDArray[np.bool_], success: NDArray[np.bool_]) -> Log:
        """TASK/return, TASK/success and TASK/ticks of the episodes that have ended."""
        log: Log = defaultdict(list)
        for row in np.flatnonzero(done):
            task = self.env.instances[row].scenario.task
            log[f"{task}/return"].append(float(self._returns[row]))
            log[f"{task}/success"].append(float(success[row]))
            log[f"{task}/ticks"].append(float(self.episode_length_buf[row]))
        return log


class ContactLearner(OnPolicyLearner):
    """PPO on `ContactEnv`."""

    def __init__(self, config: PpoTrainConfig, first_episode: int = 0) -> None:
        """``first_episode``: number of the first episode; a resumed run continues its count."""
        self.config = config
        env = ContactEnv(
            config.env, config.tasks, config.robots, config.network, config.seed, first_episode
        )
        cnn = {
            "output_channels": list(config.network.channels),
            "kernel_size": list(KERNELS),
            "stride": list(STRIDES),
            "activation": "elu",
        }
        model = {
            "class_name": "CNNModel",
            "hidden_dims": list(config.network.hidden),
            "activation": "elu",
            "obs_normalization": True,
            "cnn_cfg": cnn,
        }
        groups = {"actor": ["depth", "state"], "critic": ["depth", "state"]}
        super().__init__(env, rsl_rl_config(config.ppo, model, model, groups, config.initial_std))

    def record(
        self, log: Log, obs: Any, reward: torch.Tensor, done: torch.Tensor, extras: dict[str, Any]
    ) -> None:
        log["reward"].append(float(reward.mean()))
        for name, values in extras["log"].items():
            log[name] += values

    def policy(self, provenance: dict[str, Any]) -> ReactiveNetwork:
        """rsl-rl's actor with its normalisation, in the format of the policy file."""
        actor = self.ppo.get_policy()
        normal = actor.obs_normalizer
        tensors = {
            "mean": normal.mean,
            "std": normal.std + normal.eps,
            **_tensors("cnn", actor.cnns["depth"], nn.Conv2d),
            **_tensors("mlp", actor.mlp, nn.Linear),
        }
        return ReactiveNetwork(tensors, self.config.network, self.env.env.controller.id, provenance)

    def state_dict(self) -> dict[str, Any]:
        """Also the number of episodes; after a resume the robots start new ones."""
        extra = {"episodes": self.env.episodes, "torch": torch.get_rng_state()}
        return super().state_dict() | extra

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        torch.set_rng_state(state["torch"])


def _tensors(
    part: str, module: nn.Module, kind: type[nn.Conv2d | nn.Linear]
) -> dict[str, torch.Tensor]:
    """``PART.I.weight`` and ``PART.I.bias`` of the layers of this kind."""
    layers = [m for m in module.children() if isinstance(m, kind)]
    return {
        f"{part}.{i}.{name}": parameter.detach().clone()
        for i, layer in enumerate(layers)
        for name, parameter in layer.named_parameters()
    }
