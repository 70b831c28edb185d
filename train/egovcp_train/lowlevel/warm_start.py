"""PPO's actor begins with the network of a trained controller, made symmetric.

PPO counts the mirror image of each sample as if the policy had chosen it (`env.mirrored`). With a
network pi that is not symmetric the probability ratios of these samples are far from 1, and the
learning rate collapses. So the actor is fitted to

    pi_sym(s) = (pi(s) + M_a pi(M_s s)) / 2

on the observations of the first iterations, while only the critic learns from rewards.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional

from egovcp.errors import UsageError
from egovcp.robot.walk_policy import OBSERVATION_CLIP, WalkPolicy
from egovcp_train.lowlevel.env import mirrored
from egovcp_train.lowlevel.sensing import PRIVILEGED_DIM

_FRAMES: Final = 10_000_000  # that the normalisation of an initial network stands for
_BATCH: Final = 1024
_LEARNING_RATE: Final = 5e-4


def linear_layers(actor: Any) -> list[nn.Linear]:
    """Of rsl-rl's actor, first to last."""
    return [m for m in actor.mlp if isinstance(m, nn.Linear)]


class SymmetricStart:
    """Copies a network into the actor, then fits the actor to its symmetric part."""

    def __init__(self, actor: Any, policy: WalkPolicy) -> None:
        """Copy network and normalisation.

        Raises:
            UsageError: the network has layers of other sizes than the actor.
        """
        _copy(actor, policy)
        self._actor = actor
        self._mean, self._std = torch.from_numpy(policy.mean), torch.from_numpy(policy.std)
        self._layers = [(torch.from_numpy(w), torch.from_numpy(b)) for w, b in policy.layers]
        self._optimizer = torch.optim.Adam(actor.mlp.parameters(), _LEARNING_RATE)

    def fit(self, env: Any, observations: Tensor) -> float:
        """One pass over observations (N, 95) and their mirror images; returns the rms error."""
        seen = TensorDict({"policy": observations}, batch_size=[len(observations)])
        seen["privileged"] = observations.new_zeros(len(observations), PRIVILEGED_DIM)
        both, _ = mirrored(env, seen, None)
        assert both is not None
        _, answers = mirrored(env, None, self._network(both["policy"]))
        assert answers is not None
        n = len(observations)
        target = 0.5 * (answers[: 2 * n] + answers[2 * n :].roll(n, dims=0))
        total = 0.0
        for rows in torch.split(torch.randperm(2 * n), _BATCH):
            loss = (self._actor(both[rows]) - target[rows]).square().mean()
            self._optimizer.zero_grad()
            loss.backward()
            self._optimizer.step()
            total += loss.item() * len(rows)
        return float((total / (2 * n)) ** 0.5)

    def _network(self, x: Tensor) -> Tensor:
        clip = OBSERVATION_CLIP
        with torch.no_grad():
            x = ((x - self._mean) / self._std).clamp(-clip, clip)
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
    normal = actor.obs_normalizer
    with torch.no_grad():
        for module, (weight, bias) in zip(linear, policy.layers, strict=True):
            module.weight.copy_(torch.from_numpy(weight))
            module.bias.copy_(torch.from_numpy(bias))
        normal._mean.copy_(torch.from_numpy(policy.mean))
        normal._std.copy_(torch.from_numpy(policy.std) - normal.eps)
        normal._var.copy_(normal._std**2)
        normal.count.fill_(_FRAMES)
