"""PPO (rsl-rl) on the low-level environment: one iteration at a time, resumable."""

from __future__ import annotations

import contextlib
import io
from collections import defaultdict
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from rsl_rl.algorithms import PPO

from egovcp.robot.walk_policy import WalkPolicy
from egovcp.robot.walking import WalkConfig
from egovcp.spec import CONTROLLER_HZ
from egovcp_train.lowlevel.config import CurriculumConfig, NetworkConfig, PpoConfig
from egovcp_train.lowlevel.env import LowLevelEnv, mirrored
from egovcp_train.lowlevel.warm_start import SymmetricStart


class PpoLearner:
    """The environment, rsl-rl's PPO and the curriculum."""

    def __init__(
        self,
        env: LowLevelEnv,
        network: NetworkConfig,
        ppo: PpoConfig,
        curriculum: CurriculumConfig,
        critic_warmup: int = 0,
    ) -> None:
        self.env, self.curriculum, self._ticks = env, curriculum, ppo.num_steps_per_env
        self.iteration = 0
        self._start: SymmetricStart | None = None
        self._critic_warmup = critic_warmup
        env.loop.difficulty = curriculum.start
        with contextlib.redirect_stdout(io.StringIO()):  # rsl-rl prints its networks
            self.ppo = PPO.construct_algorithm(
                env.get_observations(), env, rsl_rl_config(network, ppo), "cpu"
            )
        start_at_zero(self.ppo.get_policy().mlp)
        self.ppo.train_mode()

    @property
    def steps(self) -> int:
        """Ticks simulated so far, over all robots."""
        return self.iteration * self._ticks * self.env.num_envs

    def start_from(self, policy: WalkPolicy) -> None:
        """Begin with the network of a trained controller.

        Raises:
            UsageError: its layers have other sizes.
        """
        self._start = SymmetricStart(self.ppo.get_policy(), policy)

    def _update(self, seen: list[torch.Tensor]) -> dict[str, float]:
        """One update of PPO; at first of the critic alone, whose advantages mean nothing yet."""
        warms_up = self.iteration < self._critic_warmup
        actor = self.ppo.get_policy()
        actor.requires_grad_(not warms_up)
        self.ppo.schedule = "fixed" if warms_up else "adaptive"
        losses: dict[str, float] = self.ppo.update()
        actor.requires_grad_(True)
        if warms_up and self._start is not None:
            losses["symmetric_error"] = self._start.fit(self.env, torch.cat(seen))
        return losses

    def iterate(self) -> dict[str, float]:
        """Collect, update, adapt the difficulty; returns scalars to log."""
        log: dict[str, list[float]] = defaultdict(list)
        falls, seen = 0.0, []
        with torch.inference_mode():
            obs = self.env.get_observations()
            for _ in range(self._ticks):
                seen.append(obs["policy"])
                obs, reward, done, extras = self.env.step(self.ppo.act(obs))
                self.ppo.process_env_step(obs, reward, done, extras)
                falls += float((done.bool() & ~extras["time_outs"]).sum())
                for name, value in extras["log"].items():
                    log[name.removeprefix("/")].append(value)
                log["reward/total"].append(float(reward.mean()) * CONTROLLER_HZ)
            self.ppo.compute_returns(obs)
        losses = self._update(seen)
        self.iteration += 1
        scalars = {name: float(np.mean(values)) for name, values in log.items()}
        scalars["falls_per_second"] = falls * CONTROLLER_HZ / (self._ticks * self.env.num_envs)
        self.env.loop.difficulty = adapted(
            self.env.loop.difficulty,
            scalars["falls_per_second"],
            scalars["reward/velocity"],
            self.curriculum,
        )
        std = self.ppo.get_policy().output_std.mean().item()
        losses |= {"learning_rate": self.ppo.learning_rate, "action_std": std}
        return scalars | {f"ppo/{name}": float(value) for name, value in losses.items()}

    def policy(self, walk: WalkConfig, provenance: dict[str, Any]) -> WalkPolicy:
        """The policy as it is now, ready to be saved."""
        return walk_policy(self.ppo.get_policy(), walk, provenance)

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimiser and difficulty; the robots start anew after a resume."""
        return {
            "ppo": self.ppo.save(),
            "iteration": self.iteration,
            "difficulty": self.env.loop.difficulty,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.ppo.load(state["ppo"], None, strict=True)
        self.iteration = int(state["iteration"])
        self.env.loop.difficulty = float(state["difficulty"])
        self.env.reseed(self.iteration)


def adapted(difficulty: float, falls: float, tracked: float, rule: CurriculumConfig) -> float:
    """The difficulty after an iteration.

    Args:
        difficulty: before, 0 to 1.
        falls: per robot and second.
        tracked: mean of the velocity reward, at most 1.
        rule: thresholds and step.
    """
    if falls < rule.few_falls and tracked > rule.tracking:
        difficulty += rule.step
    elif falls > rule.many_falls:
        difficulty -= rule.step
    return min(max(difficulty, 0.0), 1.0)


def walk_policy(actor: Any, walk: WalkConfig, provenance: dict[str, Any]) -> WalkPolicy:
    """rsl-rl's actor as a controller's file holds it, with its normalisation."""
    linear = [m for m in actor.mlp if isinstance(m, torch.nn.Linear)]
    normal = actor.obs_normalizer
    return WalkPolicy(
        normal.mean.cpu().numpy(),
        (normal.std + normal.eps).cpu().numpy(),
        tuple((m.weight.detach().cpu().numpy(), m.bias.detach().cpu().numpy()) for m in linear),
        walk,
        provenance,
    )


def start_at_zero(mlp: torch.nn.Sequential) -> None:
    """Begin with hardly any residual, as symmetric as the robot.

    The mirrored copies of a sample count as if the policy had chosen them, too: with a policy
    that is far from symmetric their probability ratios drown what the samples say.
    """
    last = [m for m in mlp if isinstance(m, torch.nn.Linear)][-1]
    with torch.no_grad():
        last.weight.mul_(0.01)
        last.bias.zero_()


def rsl_rl_config(network: NetworkConfig, ppo: PpoConfig) -> dict[str, Any]:
    """rsl-rl's configuration of actor, critic and PPO."""
    options = asdict(ppo)
    steps = options.pop("num_steps_per_env")
    shared = {"class_name": "MLPModel", "activation": network.activation, "obs_normalization": True}
    noise = {
        "class_name": "GaussianDistribution",
        "init_std": network.initial_std,
        "std_type": "log",
    }
    return {
        "num_steps_per_env": steps,
        "obs_groups": {"actor": ["policy"], "critic": ["policy", "privileged"]},
        "actor": shared | {"hidden_dims": list(network.actor), "distribution_cfg": noise},
        "critic": shared | {"hidden_dims": list(network.critic)},
        "algorithm": options
        | {
            "class_name": "PPO",
            "schedule": "adaptive",
            "symmetry_cfg": {"data_augmentation_func": mirrored, "use_data_augmentation": True},
            "rnd_cfg": None,
        },
        "multi_gpu": None,
    }
