"""The terms of the training objective (paper equations 6 to 9) over sequences [B, T, ...].

Alignment of a row t: the model filters o_t after a_{t-1}; Q_t judges a_t against the
Monte Carlo return from t; D judges the state that a_t has produced, (h_{t+1}, z^_{t+1}),
because it is not conditioned on an action and the terminal observation is not stored.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from egovcp import spec
from egovcp.model.config import LossConfig
from egovcp.model.depth import highest_3x3, lowest_3x3, nearness, within
from egovcp.model.gaussian import Gaussian, kl_divergence
from egovcp.model.world_model import PASSING_UNIT, Carry, WorldModel


class Batch(NamedTuple):
    """Sequences; what each tensor holds is fixed by `egovcp.data.stream`."""

    depth: Tensor  # (B, T, 48, 64) mm, int32 or uint16-valued
    state: Tensor  # (B, T, 74)
    action: Tensor  # (B, T, 7)
    prev_action: Tensor  # (B, T, 7), a_{t-1} as sent; zeros at the start of an episode
    is_first: Tensor  # (B, T) bool
    valid: Tensor  # (B, T) bool, False on padding
    mc_return: Tensor  # (B, T)
    mc_valid: Tensor  # (B, T) bool
    terminal_next: Tensor  # (B, T) bool: a_t ended the episode in failure
    passing: Tensor  # (B, T, 9), see `egovcp.data.EpisodeStore`
    reward: Tensor  # (B, T), after a_t


class Rollout(NamedTuple):
    """The filtered sequence, (B, T, ...)."""

    carry: Carry
    posterior: Gaussian
    prior: Gaussian
    near: Tensor  # (B, T, 48, 64)
    state: Tensor  # (B, T, 74) standardised
    embedding: Tensor  # (B, T, units) of the observation alone


def filter_sequence(
    model: WorldModel,
    batch: Batch,
    carry: Carry | None = None,
    generator: torch.Generator | None = None,
    *,
    sample: bool = True,
) -> Rollout:
    """Run the posterior over whole sequences, as `WorldModel.observe` does step by step.

    Training samples z; without ``sample`` z is the posterior mean, as it is on the robot.
    """
    size, length = batch.valid.shape
    near = nearness(batch.depth.flatten(0, 1), model.config.depth_max_m)
    state = model.standardise(batch.state)
    embedding = model.embed_near(near, state.flatten(0, 1)).view(size, length, -1)
    carry = model.initial(size) if carry is None else carry
    hs: list[Tensor] = []
    zs: list[Tensor] = []
    posteriors: list[Gaussian] = []
    for t in range(length):
        h = model.advance(carry, batch.prev_action[:, t], batch.is_first[:, t])
        posterior = model.infer(h, embedding[:, t])
        carry = Carry(h, posterior.sample(generator) if sample else posterior.mean)
        hs.append(carry.h)
        zs.append(carry.z)
        posteriors.append(posterior)
    h_seq = torch.stack(hs, 1)
    means, stds = (torch.stack(s, 1) for s in zip(*posteriors, strict=True))
    return Rollout(
        Carry(h_seq, torch.stack(zs, 1)),
        Gaussian(means, stds),
        model.predict(h_seq),
        near.view(size, length, *near.shape[1:]),
        state,
        embedding,
    )


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Mean of x where mask; 0 where the mask is empty."""
    weight = mask.to(x.dtype)
    return (x * weight).sum() / weight.sum().clamp_min(1.0)


def depth_loss(
    model: WorldModel,
    rollout: Rollout,
    valid: Tensor,
    weight: Tensor,
    every: int = 1,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Gaussian negative log likelihood of every n-th image, pixels weighted.

    Args:
        model: the world model.
        rollout: the filtered batch.
        valid: (B, T) bool, rows that count.
        weight: (B, T, H, W) of the pixels.
        every: n; the first image is drawn at random.
        generator: draws it.
    """
    every = min(every, valid.shape[1])
    first = int(torch.randint(every, (), generator=generator, device=valid.device))
    rows = (slice(None), slice(first, None, every))
    image = model.picture(rollout.carry.rows(rows).flat())
    error = 0.5 * (image - rollout.near[rows].flatten(0, 1)).square()
    error = error * weight[rows].flatten(0, 1)
    return masked_mean(error.mean((-2, -1)), valid[rows].flatten())


def pixel_weights(near: Tensor, batch: Batch, config: LossConfig) -> Tensor:
    """How much each pixel of (B, T, H, W) nearness counts: 1, and more where something moves.

    What flies is weighted in a disc somewhat larger than itself, so that painting it beside its
    place is no cheaper than not painting it.
    """
    weight = torch.ones_like(near)
    if config.moving > 0:
        moving = moving_pixels(near, config.moving_threshold)
        weight += config.moving * moving.masked_fill(batch.is_first[..., None, None], 0.0)
    if config.near > 0:
        weight += config.near * (near > config.near_threshold)
    if config.flight > 0:
        place = batch.passing[..., spec.IN_PICTURE]
        flies = place[..., 2] > 0
        weight[flies] += config.flight * within(near[flies], place[flies])
    return weight


def moving_pixels(near: Tensor, threshold: float) -> Tensor:
    """(B, T, H, W) nearness -> 1 where a pixel differs from all 3 x 3 around it in the previous
    frame, else 0: the robot's own sway moves edges by a pixel and slides along the floor."""
    before = near[:, :-1].flatten(0, 1)
    low, high = (f(before).view_as(near[:, 1:]) for f in (lowest_3x3, highest_3x3))
    change = (near[:, 1:] > high + threshold) | (near[:, 1:] < low - threshold)
    return F.pad(change, (0, 0, 0, 0, 1, 0)).to(near.dtype)


def motion_loss(model: WorldModel, rollout: Rollout, batch: Batch) -> Tensor:
    """Where in the picture something flies, now and some ticks ahead, and whether anything does.

    In the image itself a distant ball is 10 of 3072 pixels, here it is the whole target. Asked
    for the future too, the state must hold the path, not only the place, and keep it while
    the ball is out of the picture. The encoder is asked as well: through a state that is not
    yet worth reading it would learn late where to look.
    """
    row, column, radius, depth = batch.passing[..., spec.IN_PICTURE].unbind(-1)
    middle = [(size - 1) / 2 for size in rollout.near.shape[-2:]]
    place = [column / middle[1] - 1, row / middle[0] - 1, 1 - depth / model.config.depth_max_m]
    known = batch.valid & (batch.passing[..., 4] > 0)
    target = torch.stack([*place, radius > 0, known], -1)
    sight = _motion_loss_at(model.sight(rollout.embedding), target, batch, 0)
    losses = [
        _motion_loss_at(prediction, target, batch, k)
        for prediction, k in zip(
            model.motion(rollout.carry).unbind(-2), model.config.motion_ahead, strict=True
        )
        if k < target.shape[1]
    ]
    return torch.stack([sight, *losses]).sum()


def _motion_loss_at(output: Tensor, target: Tensor, batch: Batch, k: int) -> Tensor:
    """Error of the place ``k`` ticks ahead, and cross entropy of there being any.

    Args:
        output: (B, T, 4).
        target: (B, T, 5) column and row in half pictures, nearness, whether, whether known.
        batch: what was recorded.
        k: ticks.
    """
    output, target = output[:, : target.shape[1] - k], target[:, k:]
    flies = target[..., 3]
    known = unbroken(batch, k) & (target[..., 4] > 0)
    # Linear beyond a few pixels: else what is far off says everything and a pixel nothing.
    place = (
        F.huber_loss(output[..., :3], target[..., :3], reduction="none", delta=0.1).sum(-1) / 0.1
    )
    presence = F.binary_cross_entropy_with_logits(output[..., 3], flies, reduction="none")
    return masked_mean(place, known & (flies > 0)) + 0.1 * masked_mean(presence, known)


def passing_loss(model: WorldModel, rollout: Rollout, batch: Batch) -> Tensor:
    """Where and when something thrown will pass the plane before the robot, and if anything will.

    Unlike a prediction some ticks ahead this stays the same target over a whole throw, seen
    or unseen, and it is what a decision needs.
    """
    output = model.decode_passing(rollout.carry.h, rollout.carry.z).float()
    place, on, known = batch.passing[..., :3], batch.passing[..., 3], batch.passing[..., 4] > 0
    known = known & batch.valid
    unit = place.new_tensor(PASSING_UNIT)
    error = F.huber_loss(output[..., :3], place / unit, reduction="none", delta=0.5).sum(-1)
    presence = F.binary_cross_entropy_with_logits(output[..., 3], on, reduction="none")
    return masked_mean(error, known & (on > 0)) + masked_mean(presence, known)


def state_loss(model: WorldModel, rollout: Rollout, batch: Batch) -> Tensor:
    """Gaussian negative log likelihood of the standardised proprioception."""
    prediction = model.decode_state(rollout.carry.h, rollout.carry.z).float()
    error = 0.5 * (prediction - rollout.state).square().mean(-1)
    return masked_mean(error, batch.valid)


def kl_losses(rollout: Rollout, valid: Tensor, config: LossConfig) -> dict[str, Tensor]:
    """The two terms of equation 8, each clipped below at the free nats."""
    q, p = rollout.posterior, rollout.prior
    to_prior = _beyond_free(kl_divergence(q.detach(), p), config)
    to_posterior = _beyond_free(kl_divergence(q, p.detach()), config)
    return {
        "kl_prior": config.kl_prior * masked_mean(to_prior, valid),
        "kl_posterior": config.kl_posterior * masked_mean(to_posterior, valid),
    }


def _beyond_free(kl: Tensor, config: LossConfig) -> Tensor:
    """(..., Z) nats -> (...,), not below the free nats."""
    if config.free_nats_per == "dimension":
        return kl.clamp_min(config.free_nats / kl.shape[-1]).sum(-1)
    return kl.sum(-1).clamp_min(config.free_nats)


def value_and_termination_losses(
    model: WorldModel, rollout: Rollout, batch: Batch, config: LossConfig
) -> dict[str, Tensor]:
    """Equations 9 and 7b, on the posterior and on states imagined from it.

    The planner asks Q about imagined states, so Q learns on them as well: k steps after
    row t the model has imagined (h_{t+k}, z^_{t+k}) from the recorded actions, and its
    value is regressed on the return of row t + k. The reward, if it is predicted at all,
    is asked of the same states.
    """
    target = (batch.mc_return - model.return_mean) / model.return_std
    usable = batch.valid & batch.mc_valid
    error = model.value_error(rollout.carry, batch.action, target)
    losses = {"value": config.value * masked_mean(error, usable)}
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
        carry = Carry(carry.h[:, :-1], carry.z[:, :-1])  # (B, T - k): the rows that exist
        if config.imagined_steps and k < length:
            same_episode = unbroken(batch, k)
            error = model.value_error(carry, batch.action[:, k:], target[:, k:])
            imagined.append(masked_mean(error, usable[:, k:] & same_episode))
            if predicts_reward:
                rewards.append(_reward_error(model, carry, batch, same_episode))
    if imagined:
        losses["imagined_value"] = config.imagined_value * torch.stack(imagined).mean()
    if rewards:
        losses["reward"] = config.reward * torch.stack(rewards).mean()
    return losses


def _reward_error(model: WorldModel, carry: Carry, batch: Batch, mask: Tensor) -> Tensor:
    """Mean squared error of the reward at the last rows of a window, as many as ``mask`` has."""
    rows = slice(batch.valid.shape[1] - mask.shape[1], None)
    target = batch.reward[:, rows] / model.return_std
    return masked_mean((model.scaled_reward(carry, batch.action[:, rows]) - target).square(), mask)


def unbroken(batch: Batch, k: int) -> Tensor:
    """(B, T - k): row t and row t + k are valid and of the same episode."""
    start = batch.is_first.long().cumsum(1)
    length = start.shape[1]
    same = start[:, k:] == start[:, : length - k]
    return same & batch.valid[:, k:] & batch.valid[:, : length - k]
