"""Losses of states imagined several ticks ahead, against what was then recorded.

Equation 8 compares prior and posterior one tick ahead only, where errors are small that grow
over several ticks. So states are also imagined over many ticks, from some rows of a window and
with the recorded actions, and their decoded images and proprioception are compared with the
recorded ones.

The same, at every tick and in the place of equation 8, is autoregressive training: from filtered
states the model goes on with nothing but its own predictions,

    h_{k+1} = f(h_k, z^_k, a_k)
    z^_{k+1} = mean of p(z | h_{k+1})
    o^_{k+1} = mean of p(o | h_{k+1}, z^_{k+1})

and the gradient of every o^ goes back through all predictions before it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from egovcp.model.config import LossConfig
from egovcp.model.fused_recurrence import imagine_window
from egovcp.model.latent_state import Carry
from egovcp.model.losses import Batch, Rollout, image_error, masked_mean, unbroken
from egovcp.model.world_model import WorldModel


class Imagined(NamedTuple):
    """States imagined from several rows, S in all."""

    carry: Carry  # (B, S, ...)
    rows: Tensor  # (S,) the row that each stands for
    known: Tensor  # (B, S) bool: there is such a row, of the same episode


class Weights(NamedTuple):
    """Weights of the two errors."""

    depth: float
    state: float


def multistep_losses(
    model: WorldModel,
    rollout: Rollout,
    batch: Batch,
    weight: Tensor,
    first: int,
) -> dict[str, Tensor]:
    """Picture and proprioception of states imagined ``multistep_horizons`` ticks ahead.

    Args:
        model: the world model.
        rollout: the filtered batch.
        batch: what was recorded.
        weight: (B, T, H, W) of the pixels.
        first: row from which is imagined, see `first_row`.
    """
    config = model.config.loss
    weights = Weights(config.multistep_depth, config.multistep_state)
    if not any(weights):
        return {}
    seen = imagine_ahead(model, rollout.carry, batch, config.multistep_horizons, first)
    return _compare("multistep", model, seen, rollout, batch, weight, weights)


def autoregressive_losses(
    model: WorldModel,
    rollout: Rollout,
    batch: Batch,
    weight: Tensor,
    first: int,
) -> dict[str, Tensor]:
    """The same at each of ``autoregressive_steps`` ticks, weighted as the reconstruction is."""
    config = model.config.loss
    weights = Weights(config.depth, config.state)
    seen = imagine_ahead(model, rollout.carry, batch, autoregressive_ticks(config), first)
    return _compare("autoregressive", model, seen, rollout, batch, weight, weights)


def autoregressive_ticks(config: LossConfig) -> range:
    """How far ahead `autoregressive_losses` looks."""
    return range(1, config.autoregressive_steps + 1)


def imagine_ahead(
    model: WorldModel,
    carry: Carry,
    batch: Batch,
    ahead: Sequence[int],
    first: int,
) -> Imagined | None:
    """Imagine ``ahead`` ticks from every n-th filtered state (B, T, ...) on, beginning at row
    ``first``, with the recorded actions; None if the window is too short for any."""
    length = batch.valid.shape[1]
    ahead = [k for k in ahead if k < length]
    if not ahead:
        return None
    every = _every(model.config.loss, ahead, length)
    ends = [max(first, length - max(k, min(ahead))) for k in range(1, max(ahead) + 1)]
    starts = [torch.arange(first, end, every, device=batch.state.device) for end in ends]
    found = _imagined(model, carry, batch, starts)
    seen = [_rows(carry, found[k - 1], starts[k - 1]) for k in ahead]
    rows = torch.cat([starts[k - 1] + k for k in ahead])
    known = torch.cat([unbroken(batch, k)[:, starts[k - 1]] for k in ahead], 1)
    return Imagined(Carry.join(seen, lambda parts: torch.cat(parts, 1)), rows, known)


def first_row(
    config: LossConfig, ahead: Sequence[int], batch: Batch, generator: torch.Generator | None
) -> int:
    """The first of every n-th row from which `imagine_ahead` goes, drawn at random."""
    every = _every(config, ahead, batch.valid.shape[1])
    return int(torch.randint(every, (), generator=generator, device=batch.state.device))


def _every(config: LossConfig, ahead: Sequence[int], length: int) -> int:
    """n: at least one row is to be imagined from, if the window is long enough for any."""
    return max(1, min(config.multistep_stride, length - min(ahead, default=length)))


def _imagined(
    model: WorldModel, carry: Carry, batch: Batch, starts: Sequence[Tensor]
) -> list[Carry]:
    """States (S B, ...) after each tick, imagined from as many rows S as it names."""
    size = len(batch.valid)
    h, z = (x[:, starts[0]].transpose(0, 1).flatten(0, 1) for x in (carry.h, carry.z))
    rows = torch.cat([start + k for k, start in enumerate(starts)])
    action = batch.action[:, rows].transpose(0, 1).flatten(0, 1)
    return imagine_window(model, Carry(h, z), action, [size * len(start) for start in starts])


def _rows(carry: Carry, imagined: Carry, start: Tensor) -> Carry:
    """The states (B, S, ...) that are imagined (S B, ...) from some rows of a carry (B, T, ...)."""
    shape = (len(start), len(carry.h))  # of no rows, where a window is too short
    h, z = (x.view(*shape, x.shape[-1]).transpose(0, 1) for x in (imagined.h, imagined.z))
    return Carry(h, z)


def _compare(
    name: str,
    model: WorldModel,
    seen: Imagined | None,
    rollout: Rollout,
    batch: Batch,
    weight: Tensor,
    weights: Weights,
) -> dict[str, Tensor]:
    """Errors of imagined states against the rows that they stand for, as terms ``NAME_...``."""
    if seen is None:
        return {}
    carry, rows, known = seen
    near = rollout.near[:, rows]
    image = model.decode_depth(carry.features.flatten(0, 1)).view_as(near)
    picture = image_error(image, near, weight[:, rows])
    foreseen = model.decode_state(carry.h, carry.z).float()
    state = 0.5 * (foreseen - rollout.state[:, rows]).square().mean(-1)
    return {
        f"{name}_depth": weights.depth * masked_mean(picture, known),
        f"{name}_state": weights.state * masked_mean(state, known),
    }
