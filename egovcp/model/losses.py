"""The terms of the training objective (paper equations 6 to 9) over sequences [B, T, ...].

Alignment of a row t: the model filters o_t after a_{t-1}; Q_t is fitted to the target of row t
(`egovcp.model.value_losses`); D classifies the state that a_t has produced, (h_{t+1}, z^_{t+1}),
because D has no action as input and the terminal observation is not stored.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from egovcp import spec
from egovcp.model.config import LossConfig
from egovcp.model.depth import extreme_3x3, nearness
from egovcp.model.fused_recurrence import filter_window
from egovcp.model.latent_state import Carry, Gaussian, kl_divergence
from egovcp.model.world_model import WorldModel

#: Images encoded at once without gradient: activations of more no longer fit into the cache.
_CHUNK: Final = 512


class Batch(NamedTuple):
    """Windows of episodes (B, T, ...)."""

    depth: Tensor  # (B, T, 48, 64) mm, int32 or uint16-valued
    state: Tensor  # (B, T, 74)
    action: Tensor  # (B, T, 7)
    prev_action: Tensor  # (B, T, 7), a_{t-1} as sent; zeros at the start of an episode
    is_first: Tensor  # (B, T) bool
    valid: Tensor  # (B, T) bool, False on padding
    mc_return: Tensor  # (B, T)
    mc_valid: Tensor  # (B, T) bool
    terminal_next: Tensor  # (B, T) bool: a_t ended the episode in failure
    reward: Tensor  # (B, T), after a_t
    privileged: Tensor  # (B, T, F), see `egovcp.data.privileged`

    @property
    def object(self) -> Tensor:
        """(B, T, 6) position and velocity of the task's object, m and m/s, heading frame."""
        return self.privileged[..., spec.OBJECT_STATE]

    @property
    def object_known(self) -> Tensor:
        """(B, T) bool."""
        return self.privileged[..., spec.OBJECT_KNOWN] > 0


class Rollout(NamedTuple):
    """The filtered sequence, (B, T, ...)."""

    carry: Carry
    posterior: Gaussian
    prior: Gaussian
    near: Tensor  # (B, T, 48, 64)
    state: Tensor  # (B, T, 74) standardised


def filter_sequence(model: WorldModel, batch: Batch, noise: Tensor | None = None) -> Rollout:
    """Run the posterior over whole sequences, as `WorldModel.observe` does step by step.

    Training samples z with ``noise`` (`latent_noise`). Without it z is the posterior mean, as in
    deployment.
    """
    size, length = batch.valid.shape
    near = nearness(batch.depth.flatten(0, 1), model.config.depth_max_m)
    state = model.standardise(batch.state)
    embedding = _embed(model, near, state.flatten(0, 1)).view(size, length, -1)
    states, posterior = filter_window(
        model, model.initial(size), batch.prev_action, batch.is_first, embedding, noise
    )
    return Rollout(
        states,
        posterior,
        model.predict(states.h),
        near.view(size, length, *near.shape[1:]),
        state,
    )


def latent_noise(model: WorldModel, batch: Batch, generator: torch.Generator | None) -> Tensor:
    """Noise of z, (T, B, Z), sampled step by step."""
    size, length = batch.valid.shape
    shape, device = (size, model.config.latent), batch.state.device
    draws = [torch.randn(shape, generator=generator, device=device) for _ in range(length)]
    return torch.stack(draws)


def _embed(model: WorldModel, near: Tensor, state: Tensor) -> Tensor:
    if torch.is_grad_enabled():
        return model.embed_near(near, state)
    return torch.cat([model.embed_near(*piece) for piece in _pieces(near, state)])


def _pieces(*rows: Tensor) -> Iterator[tuple[Tensor, ...]]:
    return zip(*(torch.split(x, _CHUNK) for x in rows), strict=True)


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Mean of x where mask; 0 where the mask is empty."""
    weight = mask.to(x.dtype)
    return (x * weight).sum() / weight.sum().clamp_min(1.0)


def image_error(image: Tensor, near: Tensor, weight: Tensor) -> Tensor:
    """Mean over the pixels of half the weighted squared error, (...,), float32.

    The gradient is written by hand: one pass over the pixels where autograd takes five.

    Args:
        image: (..., H, W) nearness as decoded.
        near: (..., H, W) as observed; no gradient.
        weight: (..., H, W) of the pixels; no gradient.
    """
    error: Tensor = _ImageError.apply(image, near, weight)  # type: ignore[no-untyped-call]
    return error


class _ImageError(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, near: Tensor, weight: Tensor) -> Tensor:
        difference = image - near
        weighted = difference * weight
        ctx.save_for_backward(weighted)
        ctx.dtype = image.dtype
        return 0.5 * difference.mul_(weighted).mean((-2, -1))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (weighted,) = ctx.saved_tensors
        pixels = weighted.shape[-2] * weighted.shape[-1]
        return (weighted * (gradient / pixels)[..., None, None]).to(ctx.dtype), None, None


def depth_loss(
    model: WorldModel,
    rollout: Rollout,
    valid: Tensor,
    weight: Tensor,
    every: int = 1,
    first: int = 0,
) -> Tensor:
    """Half the squared error of every n-th image, weighted mean over its pixels.

    Args:
        valid: (B, T) bool, rows to average over.
        weight: (B, T, H, W) of the pixels.
        every: n.
        first: index of the first image, see `first_image`.
    """
    rows = (slice(None), slice(first, None, min(every, valid.shape[1])))
    near = rollout.near[rows]
    image = model.decode_depth(rollout.carry.features[rows].flatten(0, 1)).view_as(near)
    return masked_mean(image_error(image, near, weight[rows]), valid[rows])


def first_image(every: int, batch: Batch, generator: torch.Generator | None) -> int:
    """Index below ``every`` of the first decoded image, random."""
    every = min(every, batch.valid.shape[1])
    return int(torch.randint(every, (), generator=generator, device=batch.valid.device))


def pixel_weights(near: Tensor, batch: Batch, model: WorldModel) -> Tensor:
    """Weight of each pixel of nearness (B, T, H, W): 1, more where it moves or is near."""
    config = model.config.loss
    weight = torch.ones_like(near)
    if config.motion_weight > 0:
        moving = _changed(near, config.motion_threshold)
        moving &= ~batch.is_first[:, 1:, None, None]
        weight[:, 1:].add_(moving, alpha=config.motion_weight)
    if config.proximity_weight > 0:
        weight += config.proximity_weight * (near > config.proximity_threshold)
    return weight


def moving_pixels(near: Tensor, threshold: float) -> Tensor:
    """(B, T, H, W) nearness -> 1 where a pixel differs from its whole 3 x 3 neighbourhood in the
    previous frame, else 0. The neighbourhood excludes edges that move by a pixel with the robot."""
    return F.pad(_changed(near, threshold), (0, 0, 0, 0, 1, 0)).to(near.dtype)


def _changed(near: Tensor, threshold: float) -> Tensor:
    """(B, T - 1, H, W) bool: `moving_pixels` of all frames that have a previous one."""
    frames = near.flatten(0, 1)
    low, high = (
        extreme_3x3(frames, f).view_as(near)[:, :-1] for f in (torch.minimum, torch.maximum)
    )
    changed = near[:, 1:] > high.add_(threshold)
    changed |= near[:, 1:] < low.sub_(threshold)
    return changed


def state_loss(model: WorldModel, rollout: Rollout, batch: Batch) -> Tensor:
    """Half the squared error of the standardised proprioception, mean over its values."""
    prediction = model.decode_state(rollout.carry.h, rollout.carry.z).float()
    error = 0.5 * (prediction - rollout.state).square().mean(-1)
    return masked_mean(error, batch.valid)


def object_loss(model: WorldModel, rollout: Rollout, batch: Batch) -> Tensor:
    """`object_error` of the rows where the object is known."""
    error = object_error(model, rollout.carry, batch.object)
    return masked_mean(error, batch.valid & batch.object_known)


def object_error(model: WorldModel, carry: Carry, state: Tensor) -> Tensor:
    """Half the squared error of the standardised position and velocity (..., 6), mean, (...,)."""
    error = model.standardised_object(carry) - model.standardise_object(state)
    return 0.5 * error.square().mean(-1)


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


def unbroken(batch: Batch, k: int) -> Tensor:
    """(B, T - k): row t and row t + k are valid and of the same episode."""
    start = batch.is_first.long().cumsum(1)
    length = start.shape[1]
    same = start[:, k:] == start[:, : length - k]
    return same & batch.valid[:, k:] & batch.valid[:, : length - k]
