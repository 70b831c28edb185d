"""Losses of the value, termination and reward heads (paper equations 9 and 7b).

The target of Q is set by ``q_target``:

* ``privileged``: the prediction of a value function that sees the position of the task's object
  (`egovcp.model.privileged_value`), for the recorded action and for some sampled ones; where none
  is given, as ``mc``;
* ``mc``: the Monte Carlo return;
* ``td``: the one-step target

      y_t = r_t + gamma (1 - d_t) Q'(h_{t+1}, z_{t+1}, a_{t+1})

  with the action that the data took next and d_t = 1 if a_t ended the episode in failure.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from egovcp.model.config import LossConfig
from egovcp.model.latent_state import Carry
from egovcp.model.losses import Batch, Rollout, masked_mean, unbroken
from egovcp.model.networks import SplitMlp
from egovcp.model.privileged_value import PrivilegedValue
from egovcp.model.world_model import WorldModel


class ValueTargets(NamedTuple):
    """What Q is fitted to at each row, for K actions."""

    action: Tensor  # (B, T, K, 7), the recorded one first
    value: Tensor  # (B, T, K) standardised
    usable: Tensor  # (B, T) bool, whether the values are known


class TargetNetwork(nn.Module):
    """A copy of the head of Q that follows it by an exponential moving average.

    Encoder and recurrence are not copied: both heads have the same inputs.
    """

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        self.head = copy.deepcopy(model.value_head)
        self.requires_grad_(False)

    @torch.no_grad()
    def update(self, model: WorldModel, decay: float) -> None:
        """Move towards the model's head: keep ``decay`` of each weight."""
        for own, new in zip(self.head.parameters(), model.value_head.parameters(), strict=True):
            own.lerp_(new, 1 - decay)


def bootstrapped(model: WorldModel, batch: Batch, values: Tensor) -> tuple[Tensor, Tensor]:
    """r_t + gamma V_{t+1} (B, T) from values V_t (B, T) in units of return, and the rows that have
    one.

    The last row of a window, or of an episode ended by the time limit, has none, because the next
    state is unknown. The row of a failure needs no next state.
    """
    later = F.pad(values[:, 1:], (0, 1)).masked_fill(batch.terminal_next, 0.0)
    known = F.pad(unbroken(batch, 1), (0, 1)) | batch.terminal_next
    return batch.reward + model.discount * later, batch.valid & known


@torch.no_grad()
def value_targets(
    model: WorldModel,
    carry: Carry,
    batch: Batch,
    critic: nn.Module | None = None,
    sampled: Tensor | None = None,
) -> ValueTargets:
    """Targets of Q at the rows of a batch.

    Args:
        model: the world model; its `LossConfig.q_target` selects the target.
        carry: the filtered states (B, T, ...).
        batch: the recorded windows.
        critic: the network that predicts the target: a `PrivilegedValue`, or the value head of the
            TD target; None: returns, or the model's own head.
        sampled: (B, T, K - 1, 7) further actions that the privileged value is asked for.
    """
    action = batch.action[:, :, None]
    if isinstance(critic, PrivilegedValue):
        if sampled is not None:
            action = torch.cat([action, sampled], 2)
        return privileged_targets(model, batch, critic, action)
    if model.config.loss.q_target == "td":
        assert critic is None or isinstance(critic, SplitMlp)
        target, usable = bootstrapped(model, batch, model.value(carry, batch.action, critic))
    else:
        target, usable = batch.mc_return, batch.valid & batch.mc_valid
    value = (target - model.return_mean) / model.return_std
    return ValueTargets(action, value[..., None], usable)


@torch.no_grad()
def privileged_targets(
    model: WorldModel, batch: Batch, critic: PrivilegedValue, action: Tensor
) -> ValueTargets:
    """The privileged value of actions (B, T, K, 7)."""
    state = model.standardise(batch.state)[:, :, None]
    value = critic(state, batch.privileged[:, :, None], action)
    return ValueTargets(action, value, batch.valid)


def value_and_termination_losses(
    model: WorldModel,
    rollout: Rollout,
    batch: Batch,
    config: LossConfig,
    critic: nn.Module | None = None,
    sampled: Tensor | None = None,
) -> dict[str, Tensor]:
    """Equations 9 and 7b, on the posterior and on states imagined from it.

    The planner evaluates Q on imagined states, so Q is also trained on them: the value of
    (h_{t+k}, z^_{t+k}), imagined from row t with the recorded actions, is fitted to the target of
    row t + k. A reward head is trained on the same states. See `value_targets` for the other
    arguments.
    """
    targets = value_targets(model, rollout.carry, batch, critic, sampled)
    error = _value_error(model, rollout.carry, targets)
    losses = {"value": config.value * masked_mean(error, targets.usable)}
    predicts_reward = model.reward_head is not None
    rewards: list[Tensor] = []
    if predicts_reward:
        rewards.append(_reward_error(model, rollout.carry, batch, batch.valid))

    carry = rollout.carry
    length = batch.valid.shape[1]
    imagined: list[Tensor] = []
    for k in range(1, max(1, config.imagined_steps) + 1):
        if k > length:
            break
        carry = model.imagine(carry, batch.action[:, k - 1 :])
        if k == 1:
            logit = model.termination_logit(carry)
            bce = F.binary_cross_entropy_with_logits(
                logit, batch.terminal_next.float(), reduction="none"
            )
            losses["termination"] = config.termination * masked_mean(bce, batch.valid)
        carry = carry.map(lambda x: x[:, :-1])  # (B, T - k)
        if config.imagined_steps and k < length:
            same_episode = unbroken(batch, k)
            later = ValueTargets(*(x[:, k:] for x in targets))
            error = _value_error(model, carry, later)
            imagined.append(masked_mean(error, later.usable & same_episode))
            if predicts_reward:
                rewards.append(_reward_error(model, carry, batch, same_episode))
    if imagined:
        losses["imagined_value"] = config.imagined_value * torch.stack(imagined).mean()
    if rewards:
        losses["reward"] = config.reward * torch.stack(rewards).mean()
    return losses


def _value_error(model: WorldModel, carry: Carry, targets: ValueTargets) -> Tensor:
    """Mean loss (B, T) of Q over the actions of each row."""
    state = carry.map(lambda x: x[:, :, None])
    return model.value_error(state, targets.action, targets.value).mean(-1)


def _reward_error(model: WorldModel, carry: Carry, batch: Batch, mask: Tensor) -> Tensor:
    """Mean squared error of the reward at the last rows of a window; ``mask`` has their number."""
    rows = slice(batch.valid.shape[1] - mask.shape[1], None)
    target = batch.reward[:, rows] / model.return_std
    return masked_mean((model.scaled_reward(carry, batch.action[:, rows]) - target).square(), mask)
