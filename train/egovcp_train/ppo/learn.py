"""PPO (rsl-rl) on the simulator: one iteration at a time, resumable."""

from __future__ import annotations

import contextlib
import io
from collections import defaultdict
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from torch import nn

from egovcp.reactive import KERNELS, STRIDES, Layer, ReactiveConfig, ReactiveNetwork
from egovcp_train.lowlevel.learn import start_at_zero
from egovcp_train.ppo.config import PpoTrainConfig
from egovcp_train.ppo.env import ContactEnv


class ContactLearner:
    """The environment and rsl-rl's PPO."""

    def __init__(self, config: PpoTrainConfig, first: int = 0) -> None:
        """``first``: the number of the first episode, after those of a run that is resumed."""
        self.config, self.iteration = config, 0
        robots, network, seed = config.robots, config.network, config.seed
        self.env = ContactEnv(config.env, config.tasks, robots, network, seed, first)
        with contextlib.redirect_stdout(io.StringIO()):  # rsl-rl prints its networks
            self.ppo = PPO.construct_algorithm(
                self.env.get_observations(), self.env, rsl_rl_config(config), "cpu"
            )
        start_at_zero(self.ppo.get_policy().mlp)  # the neutral pose
        self.ppo.train_mode()

    @property
    def steps(self) -> int:
        """Ticks simulated so far, over all robots."""
        return self.iteration * self.config.ppo.num_steps_per_env * self.config.robots

    def iterate(self) -> dict[str, float]:
        """Collect and update; returns scalars to log."""
        log: dict[str, list[float]] = defaultdict(list)
        with torch.inference_mode():
            obs = self.env.get_observations()
            for _ in range(self.config.ppo.num_steps_per_env):
                obs, reward, done, extras = self.env.step(self.ppo.act(obs))
                self.ppo.process_env_step(obs, reward, done, extras)
                log["reward"].append(float(reward.mean()))
                for name, values in extras["log"].items():
                    log[name] += values
            self.ppo.compute_returns(obs)
        losses = self.ppo.update()
        self.iteration += 1
        std = self.ppo.get_policy().output_std.mean().item()
        losses |= {"learning_rate": self.ppo.learning_rate, "action_std": std}
        scalars = {name: float(np.mean(values)) for name, values in log.items()}
        return scalars | {f"ppo/{name}": float(value) for name, value in losses.items()}

    def policy(self, provenance: dict[str, Any]) -> ReactiveNetwork:
        """The actor as it is now, ready to be saved."""
        controller = self.env.env.controller.id
        return exported(self.ppo.get_policy(), self.config.network, controller, provenance)

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimiser and the number of episodes; the robots start anew after a resume."""
        return {
            "ppo": self.ppo.save(),
            "iteration": self.iteration,
            "episodes": self.env.episodes,
            "torch": torch.get_rng_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.ppo.load(state["ppo"], None, strict=True)
        self.iteration = int(state["iteration"])
        torch.set_rng_state(state["torch"])


def exported(
    actor: Any, config: ReactiveConfig, controller_id: str, provenance: dict[str, Any]
) -> ReactiveNetwork:
    """rsl-rl's actor as the policy's file holds it, with its normalisation."""
    normal = actor.obs_normalizer
    return ReactiveNetwork(
        normal.mean,
        normal.std + normal.eps,
        _layers(actor.cnns["depth"], nn.Conv2d),
        _layers(actor.mlp, nn.Linear),
        config,
        controller_id,
        provenance,
    )


def _layers(module: nn.Module, kind: type[nn.Conv2d | nn.Linear]) -> tuple[Layer, ...]:
    found = [dict(m.named_parameters()) for m in module.children() if isinstance(m, kind)]
    return tuple((x["weight"].detach().clone(), x["bias"].detach().clone()) for x in found)


def rsl_rl_config(config: PpoTrainConfig) -> dict[str, Any]:
    """rsl-rl's configuration of actor, critic and PPO."""
    network, options = config.network, asdict(config.ppo)
    steps = options.pop("num_steps_per_env")
    cnn = {
        "output_channels": list(network.channels),
        "kernel_size": list(KERNELS),
        "stride": list(STRIDES),
        "activation": "elu",
    }
    model = {
        "class_name": "CNNModel",
        "hidden_dims": list(network.hidden),
        "activation": "elu",
        "obs_normalization": True,
        "cnn_cfg": cnn,
    }
    noise = {
        "class_name": "GaussianDistribution",
        "init_std": config.initial_std,
        "std_type": "log",
    }
    return {
        "num_steps_per_env": steps,
        "obs_groups": {"actor": ["depth", "state"], "critic": ["depth", "state"]},
        "actor": model | {"distribution_cfg": noise},
        "critic": dict(model),
        "algorithm": options
        | {
            "class_name": "PPO",
            "schedule": "adaptive",
            "symmetry_cfg": None,
            "rnd_cfg": None,
        },
        "multi_gpu": None,
    }
