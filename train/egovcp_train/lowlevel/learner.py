"""PPO on the low-level environment, with a curriculum and the start from a trained controller."""

from __future__ import annotations

from typing import Any, Final

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional

from egovcp.errors import UsageError
from egovcp.robot.walk_policy import OBSERVATION_CLIP, WalkPolicy
from egovcp.robot.walking import WalkConfig
from egovcp.spec import CONTROLLER_HZ
from egovcp_train import on_policy
from egovcp_train.lowlevel.config import CurriculumConfig, NetworkConfig
from egovcp_train.lowlevel.env import LowLevelEnv, mirrored
from egovcp_train.lowlevel.sensing import PRIVILEGED_DIM
from egovcp_train.on_policy import Log, OnPolicyLearner, RslRlPpoConfig

_FRAMES: Final = 10_000_000  # weight of an initial network's normalisation, observations
_BATCH: Final = 1024
_LEARNING_RATE: Final = 5e-4


def rsl_rl_config(network: NetworkConfig, ppo: RslRlPpoConfig) -> dict[str, Any]:
    """rsl-rl's configuration of actor, critic and PPO."""
    shared = {"class_name": "MLPModel", "activation": "elu", "obs_normalization": True}
    return on_policy.rsl_rl_config(
        ppo,
        shared | {"hidden_dims": list(network.actor)},
        shared | {"hidden_dims": list(network.critic)},
        {"actor": ["policy"], "critic": ["policy", "privileged"]},
        network.initial_std,
        {"data_augmentation_func": mirrored, "use_data_augmentation": True},
    )


def linear_layers(actor: Any) -> list[nn.Linear]:
    """Layers of rsl-rl's actor, first to last."""
    return [m for m in actor.mlp if isinstance(m, nn.Linear)]


def walk_policy(actor: Any, walk: WalkConfig, provenance: dict[str, Any]) -> WalkPolicy:
    """rsl-rl's actor with its normalisation, as the file of a controller holds it."""
    normal = actor.obs_normalizer
    return WalkPolicy(
        normal.mean.cpu().numpy(),
        (normal.std + normal.eps).cpu().numpy(),
        tuple(
            (m.weight.detach().cpu().numpy(), m.bias.detach().cpu().numpy())
            for m in linear_layers(actor)
        ),
        walk,
        provenance,
    )


def next_difficulty(
    difficulty: float, falls: float, tracked: float, rule: CurriculumConfig
) -> float:
    """The difficulty after an iteration.

    Args:
        difficulty: before, 0 to 1.
        falls: per robot and second.
        tracked: mean of the velocity reward, at most 1.
        rule: thresholds and step.
    """
    if falls < rule.low_fall_rate and tracked > rule.tracking:
        difficulty += rule.step
    elif falls > rule.high_fall_rate:
        difficulty -= rule.step
    return min(max(difficulty, 0.0), 1.0)


class LowLevelLearner(OnPolicyLearner):
    """The environment, PPO and the curriculum."""

    def __init__(
        self,
        env: LowLevelEnv,
        network: NetworkConfig,
        ppo: RslRlPpoConfig,
        curriculum: CurriculumConfig,
        critic_warmup: int = 0,
    ) -> None:
        super().__init__(env, rsl_rl_config(network, ppo))
        self.curriculum = curriculum
        self._start: SymmetricStart | None = None
        self._critic_warmup = critic_warmup
        self._seen: list[Tensor] = []
        env.logic.difficulty = curriculum.start

    def start_from(self, policy: WalkPolicy, resumed: bool = False) -> None:
        """Initialise the actor with the network of a trained controller; see `SymmetricStart`.

        Args:
            resumed: the run is resumed within the warm-up; `load_state_dict` restores the actor.

        Raises:
            UsageError: its layers have other sizes.
        """
        self._start = SymmetricStart(self.ppo.get_policy(), policy, copy=not resumed)

    def update(self) -> dict[str, float]:
        """One update; in the first iterations of the critic alone, if so configured."""
        warms_up = self.iteration < self._critic_warmup
        actor = self.ppo.get_policy()
        actor.requires_grad_(not warms_up)
        self.ppo.schedule = "fixed" if warms_up else "adaptive"
        losses = super().update()
        actor.requires_grad_(True)
        if warms_up and self._start is not None:
            losses["symmetric_error"] = self._start.fit(self.env, torch.cat(self._seen))
        self._seen.clear()
        return losses

    def record(
        self, log: Log, obs: Any, reward: Tensor, done: Tensor, extras: dict[str, Any]
    ) -> None:
        if self._start is not None and self.iteration < self._critic_warmup:
            self._seen.append(obs["policy"])
        fell = done.bool() & ~extras["time_outs"]
        log["falls_per_second"].append(float(fell.sum()) / self.env.num_envs * CONTROLLER_HZ)
        log["reward/total"].append(float(reward.mean()) * CONTROLLER_HZ)
        for name, value in extras["log"].items():
            log[name.removeprefix("/")].append(value)

    def iterate(self) -> dict[str, float]:
        """Collect, update, adapt the difficulty; returns scalars to log."""
        scalars = super().iterate()
        logic = self.env.logic
        logic.difficulty = next_difficulty(
            logic.difficulty,
            scalars["falls_per_second"],
            scalars["reward/velocity"],
            self.curriculum,
        )
        return scalars

    def state_dict(self) -> dict[str, Any]:
        state = super().state_dict() | {
            "difficulty": self.env.logic.difficulty,
            "torch_rng": torch.get_rng_state(),
        }
        if self._start is not None and self.iteration < self._critic_warmup:
            state["start_optimizer"] = self._start.optimizer.state_dict()
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.env.logic.difficulty = float(state["difficulty"])
        # earlier versions did not store these
        if "torch_rng" in state:
            torch.set_rng_state(state["torch_rng"])
        if self._start is not None and "start_optimizer" in state:
            self._start.optimizer.load_state_dict(state["start_optimizer"])
        self.env.reseed(self.iteration)


class SymmetricStart:
    """Initialises the actor with a trained network pi, then fits it to the symmetric part of pi.

    PPO treats the mirror image of each sample as if the policy had chosen it (`env.mirrored`). If
    pi is not symmetric, the probability ratios of these samples are far from 1, and the learning
    rate collapses. So the actor is fitted to

        pi_sym(s) = (pi(s) + M_a pi(M_s s)) / 2

    on the observations of the first iterations, in which only the critic learns from rewards.
    """

    def __init__(self, actor: Any, policy: WalkPolicy, copy: bool = True) -> None:
        """With ``copy``, copy network and normalisation.

        Raises:
            UsageError: the network has layers of other sizes than the actor.
        """
        if copy:
            _copy(actor, policy)
        self._actor = actor
        self._mean, self._std = torch.from_numpy(policy.mean), torch.from_numpy(policy.std)
        self._layers = [(torch.from_numpy(w), torch.from_numpy(b)) for w, b in policy.layers]
        self.optimizer = torch.optim.Adam(actor.mlp.parameters(), _LEARNING_RATE)

    def fit(self, env: Any, observations: Tensor) -> float:
        """One pass over observations (N, 95) and their mirror images; returns the RMS error."""
        n = len(observations)
        seen = TensorDict({"policy": observations}, batch_size=[n])
        seen["privileged"] = observations.new_zeros(n, PRIVILEGED_DIM)
        both, _ = mirrored(env, seen, None)
        assert both is not None
        _, answers = mirrored(env, None, self._network(both["policy"]))
        assert answers is not None
        target = 0.5 * (answers[: 2 * n] + answers[2 * n :].roll(n, dims=0))
        total = 0.0
        for rows in torch.split(torch.randperm(2 * n), _BATCH):
            loss = (self._actor(both[rows]) - target[rows]).square().mean()
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            total += loss.item() * len(rows)
        return float((total / (2 * n)) ** 0.5)

    def _network(self, x: Tensor) -> Tensor:
        with torch.no_grad():
            x = ((x - self._mean) / self._std).clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP)
            for weight, bias in self._layers[:-1]:
                x = functional.elu(functional.linear(x, weight, bias))
            return functional.linear(x, *self._layers[-1])


def _copy(actor: Any, policy: WalkPolicy) -> None:
    linear = linear_layers(actor)
    found, expected = [len(b) for _, b in policy.layers], [m.out_features for m in linear]
    if found != expected:
        raise UsageError(
            f"--init: found layers of {found} neurons, expected {expected}; choose "
            f"--network.actor={found[:-1]}"
        )
    with torch.no_grad():
        for module, (weight, bias) in zip(linear, policy.layers, strict=True):
            module.weight.copy_(torch.from_numpy(weight))
            module.bias.copy_(torch.from_numpy(bias))
    normal = actor.obs_normalizer
    mean, std = torch.from_numpy(policy.mean)[None], torch.from_numpy(policy.std)[None] - normal.eps
    count = torch.tensor(_FRAMES)
    normal.load_state_dict({"_mean": mean, "_std": std, "_var": std**2, "count": count})
