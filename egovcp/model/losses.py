"""The terms of the training objective (paper equations 6 to 9) over sequences [B, T, ...].

Alignment of a row t: the model filters o_t after a_{t-1}; Q_t judges a_t against the
Monte Carlo return from t; D judges the state that a_t has produced, (h_{t+1}, z^_{t+1}),
because it is not conditioned on an action and the terminal observation is not stored.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from egovcp import spec
from egovcp.model.camera_pose import CameraPose
from egovcp.model.carry import Carry
from egovcp.model.config import LossConfig
from egovcp.model.depth import highest_3x3, lowest_3x3, nearness, within
from egovcp.model.flight import Sighting
from egovcp.model.floor import Floor
from egovcp.model.gaussian import Gaussian, kl_divergence
from egovcp.model.kept import constant
from egovcp.model.picture_error import picture_error
from egovcp.model.recurrence import filter_window
from egovcp.model.shared import over_all_rows, row_noise
from egovcp.model.world_model import PASSING_UNIT, Look, WorldModel

#: Pictures that are looked at together where no gradient is asked for: what the layers make of more
#: no longer fits into a cache, nor into the memory that the allocator keeps.
_AT_ONCE: Final = 512


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
    noise: Tensor | None = None,
) -> Rollout:
    """Run the posterior over whole sequences, as `WorldModel.observe` does step by step.

    Training samples z, with ``noise`` (`latent_noise`) if it is drawn already; without ``sample``
    z is the posterior mean, as it is on the robot.
    """
    size, length = batch.valid.shape
    near = nearness(batch.depth.flatten(0, 1), model.config.depth_max_m)
    state = model.standardise(batch.state)
    embedding = _embed(model, near, state.flatten(0, 1)).view(size, length, -1)
    carry = model.initial(size) if carry is None else carry
    followed = _followed(model, batch, near, embedding, carry)
    if sample and noise is None:
        noise = latent_noise(model, batch, generator)
    states, posterior = filter_window(
        model, carry, batch.prev_action, batch.is_first, embedding, noise
    )
    return Rollout(
        states._replace(flight=followed),
        posterior,
        model.predict(states.h),
        near.view(size, length, *near.shape[1:]),
        state,
        embedding,
    )


def latent_noise(
    model: WorldModel, batch: Batch, generator: torch.Generator | None = None
) -> Tensor:
    """What z is sampled with, (T, B, Z), drawn a tick at a time."""
    size, length = batch.valid.shape
    shape, device = (size, model.config.latent), batch.state.device
    return torch.stack([row_noise(shape, generator, device) for _ in range(length)])


def _embed(model: WorldModel, near: Tensor, state: Tensor) -> Tensor:
    if torch.is_grad_enabled():
        return model.embed_near(near, state)
    return torch.cat([model.embed_near(*piece) for piece in _pieces(near, state)])


def _pieces(*rows: Tensor) -> Iterator[tuple[Tensor, ...]]:
    return zip(*(torch.split(x, _AT_ONCE) for x in rows), strict=True)


def _followed(
    model: WorldModel, batch: Batch, near: Tensor, embedding: Tensor, start: Carry
) -> Tensor | None:
    """What is remembered of a flight at every row, (B, T, ...)."""
    memory = start.flight
    if memory is None:
        return None
    # Metres in eight bits would be off by a hand's breadth.
    with torch.autocast(near.device.type, enabled=False):
        return _follow(model, batch, near, embedding.float(), memory)


def _follow(
    model: WorldModel, batch: Batch, near: Tensor, embedding: Tensor, memory: Tensor
) -> Tensor:
    size, length = batch.valid.shape
    pieces = _pieces(near, batch.state.flatten(0, 1), embedding.flatten(0, 1))
    looks = [[x for part in model.look(*piece) for x in part] for piece in pieces]
    point, weight, axes, position, rate, ground, shown = (
        torch.cat(column).view(size, length, *column[0].shape[1:])
        for column in zip(*looks, strict=True)
    )
    look = Look(Sighting(point, weight), CameraPose(axes, position, rate), Floor(ground, shown))
    return model.follow_all(memory, look, batch.is_first)


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Mean of x where mask; 0 where the mask is empty.

    Of a batch that processes share (`egovcp.model.shared`): this one's part of the mean.
    """
    weight = mask.to(x.dtype)
    return (x * weight).sum() / over_all_rows(weight.sum()).clamp_min(1.0)


def depth_loss(
    model: WorldModel,
    rollout: Rollout,
    valid: Tensor,
    weight: Tensor,
    every: int = 1,
    first: int = 0,
) -> Tensor:
    """Gaussian negative log likelihood of every n-th image, pixels weighted.

    Args:
        model: the world model.
        rollout: the filtered batch.
        valid: (B, T) bool, rows that count.
        weight: (B, T, H, W) of the pixels.
        every: n.
        first: the first of them, see `first_image`.
    """
    rows = (slice(None), slice(first, None, min(every, valid.shape[1])))
    near = rollout.near[rows]
    image = model.decode_depth(rollout.carry.features[rows].flatten(0, 1)).view_as(near)
    return masked_mean(picture_error(image, near, weight[rows]), valid[rows])


def first_image(every: int, batch: Batch, generator: torch.Generator | None = None) -> int:
    """The first of every n-th image that is decoded, drawn at random."""
    every = min(every, batch.valid.shape[1])
    return int(torch.randint(every, (), generator=generator, device=batch.valid.device))


def pixel_weights(near: Tensor, batch: Batch, model: WorldModel) -> Tensor:
    """How much each pixel of (B, T, H, W) nearness counts: 1, and more where something moves.

    What flies is none of the decoder's business if it is painted over its picture. Else it is
    weighted in a disc somewhat larger than itself, so that painting it beside its place is no
    cheaper than not painting it.
    """
    config = model.config.loss
    weight = torch.ones_like(near)
    if config.moving > 0:
        moving = _changed(near, config.moving_threshold)
        moving &= ~batch.is_first[:, 1:, None, None]
        weight[:, 1:].add_(moving, alpha=config.moving)
    if config.near > 0:
        weight += config.near * (near > config.near_threshold)
    place = batch.passing[..., spec.IN_PICTURE]
    if not model.config.paint_flight and config.flight == 0:
        return weight
    # In few pictures anything flies, but who picks them waits for a GPU to say which.
    rows: Any = place[..., 2] > 0 if near.device.type == "cpu" else slice(None)
    seen = near[rows]
    disc = within(seen.flatten(0, -3), place[rows].flatten(0, -2)).view_as(seen)
    if model.config.paint_flight:
        weight[rows] *= ~disc
    else:
        weight[rows] += config.flight * disc
    return weight


def moving_pixels(near: Tensor, threshold: float) -> Tensor:
    """(B, T, H, W) nearness -> 1 where a pixel differs from all 3 x 3 around it in the previous
    frame, else 0: the robot's own sway moves edges by a pixel and slides along the floor."""
    return F.pad(_changed(near, threshold), (0, 0, 0, 0, 1, 0)).to(near.dtype)


def _changed(near: Tensor, threshold: float) -> Tensor:
    """(B, T - 1, H, W) bool: `moving_pixels` of all frames that have a previous one."""
    around = (f(near.flatten(0, 1)).view_as(near) for f in (lowest_3x3, highest_3x3))
    low, high = (x[:, :-1] for x in around)
    changed = near[:, 1:] > high.add_(threshold)
    changed |= near[:, 1:] < low.sub_(threshold)
    return changed


def motion_loss(model: WorldModel, rollout: Rollout, batch: Batch) -> Tensor:
    """Where in the picture something flies, now and some ticks ahead, and whether anything does.

    In the image itself a distant ball is 10 of 3072 pixels, here it is the whole target. Asked
    for the future too, the state must hold the path, not only the place, and keep it while
    the ball is out of the picture. The encoder is asked as well: through a state that is not
    yet worth reading it would learn late where to look.
    """
    target = motion_target(batch, model.config.depth_max_m)
    losses = [motion_error(model.sight(rollout.embedding), target, batch.valid)]
    length = batch.valid.shape[1]
    outputs = model.motion(rollout.carry).unbind(-2)
    for output, k in zip(outputs, model.config.motion_ahead, strict=True):
        if k < length:
            losses.append(motion_error(output[:, : length - k], target[:, k:], unbroken(batch, k)))
    return torch.stack(losses).sum()


def motion_target(batch: Batch, max_m: float) -> Tensor:
    """(B, T, 5): column and row in half pictures, nearness, whether anything flies, whether that
    is known."""
    row, column, radius, depth = batch.passing[..., spec.IN_PICTURE].unbind(-1)
    across, down = (2 / (size - 1) for size in (spec.DEPTH_COLS, spec.DEPTH_ROWS))
    place = [column * across - 1, row * down - 1, 1 - depth / max_m]
    return torch.stack([*place, radius > 0, batch.passing[..., 4] > 0], -1)


def motion_error(output: Tensor, target: Tensor, counts: Tensor) -> Tensor:
    """Error of the place, and cross entropy of there being any.

    Args:
        output: (..., 4), see `WorldModel.motion`.
        target: (..., 5), see `motion_target`.
        counts: (...,) bool, rows that count.
    """
    flies = target[..., 3]
    known = counts & (target[..., 4] > 0)
    # Linear beyond a few pixels: else what is far off says everything and a pixel nothing.
    place = (
        F.huber_loss(output[..., :3], target[..., :3], reduction="none", delta=0.1).sum(-1) / 0.1
    )
    presence = F.binary_cross_entropy_with_logits(output[..., 3], flies, reduction="none")
    return masked_mean(place, known & (flies > 0)) + 0.3 * masked_mean(presence, known)


def passing_loss(model: WorldModel, rollout: Rollout, batch: Batch) -> Tensor:
    """Where and when something thrown will pass the plane before the robot, and if anything will.

    Unlike a prediction some ticks ahead this stays the same target over a whole throw, seen
    or unseen, and it is what a decision needs.
    """
    output = model.decode_passing(rollout.carry.h, rollout.carry.z).float()
    place, on, known = batch.passing[..., :3], batch.passing[..., 3], batch.passing[..., 4] > 0
    known = known & batch.valid
    unit = constant(PASSING_UNIT, place)
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


def unbroken(batch: Batch, k: int) -> Tensor:
    """(B, T - k): row t and row t + k are valid and of the same episode."""
    start = batch.is_first.long().cumsum(1)
    length = start.shape[1]
    same = start[:, k:] == start[:, : length - k]
    return same & batch.valid[:, k:] & batch.valid[:, : length - k]
