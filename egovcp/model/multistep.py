"""Losses of states imagined several steps ahead, against the recorded observations.

Equation 8 compares prior and posterior one step ahead, where errors that grow over several steps
are still small. These losses imagine several steps from some rows of a window, with the recorded
actions, and compare the decoded images, proprioception and object position with the recorded ones.

Autoregressive training does so at every step and replaces equation 8: from filtered states the
model continues with its own predictions,

    h_{k+1} = f(h_k, z^_k, a_k)
    z^_{k+1} = mean of p(z | h_{k+1})
    o^_{k+1} = mean of p(o | h_{k+1}, z^_{k+1})

and the gradient of every o^ flows through all earlier predictions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from egovcp.model.config import LossConfig
from egovcp.model.fused_recurrence import imagine_window
from egovcp.model.latent_state import Carry
from egovcp.model.losses import (
    Batch,
    Rollout,
    image_error,
    masked_mean,
    object_error,
    unbroken,
)
from egovcp.model.world_model import WorldModel


class Imagined(NamedTuple):
    """States imagined from several rows, S in all."""

    carry: Carry  # (B, S, ...)
    rows: Tensor  # (S,) rows of the window that they predict
    known: Tensor  # (B, S) bool: that row exists and is of the same episode


class _TermWeights(NamedTuple):
    """Weights of the terms."""

    depth: float
    state: float
    object: float


def multistep_losses(
    model: WorldModel,
    rollout: Rollout,
    batch: Batch,
    weight: Tensor,
    first: int,
) -> dict[str, Tensor]:
    """Decoded observations and object of states imagined ``multistep_horizons`` steps ahead.

    Args:
        weight: (B, T, H, W) of the pixels.
        first: first row to imagine from, see `first_row`.
    """
    config = model.config.loss
    weights = _TermWeights(config.multistep_depth, config.multistep_state, config.multistep_object)
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
    """The same at each of ``autoregressive_steps`` steps, weighted like the reconstruction."""
    config = model.config.loss
    weights = _TermWeights(config.depth, config.state, config.object)
    seen = imagine_ahead(model, rollout.carry, batch, autoregressive_horizons(config), first)
    return _compare("autoregressive", model, seen, rollout, batch, weight, weights)


def autoregressive_horizons(config: LossConfig) -> range:
    """Horizons of `autoregressive_losses`, steps."""
    return range(1, config.autoregressive_steps + 1)


def imagine_ahead(
    model: WorldModel,
    carry: Carry,
    batch: Batch,
    ahead: Sequence[int],
    first: int,
) -> Imagined | None:
    """Imagine with the recorded actions from every n-th filtered state (B, T, ...).

    Args:
        ahead: horizons, steps.
        first: first row to imagine from.

    Returns:
        The states at these horizons; None if the window is shorter than all of them.
    """
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
    """Random first row for `imagine_ahead`, below n."""
    every = _every(config, ahead, batch.valid.shape[1])
    return int(torch.randint(every, (), generator=generator, device=batch.state.device))


def _every(config: LossConfig, ahead: Sequence[int], length: int) -> int:
    """n, small enough that a window longer than the shortest horizon has a first row."""
    return max(1, min(config.multistep_stride, length - min(ahead, default=length)))


def _imagined(
    model: WorldModel, carry: Carry, batch: Batch, starts: Sequence[Tensor]
) -> list[Carry]:
    """States (S B, ...) after each step; ``starts`` has the S start rows of each step."""
    size = len(batch.valid)
    h, z = (x[:, starts[0]].transpose(0, 1).flatten(0, 1) for x in (carry.h, carry.z))
    rows = torch.cat([start + k for k, start in enumerate(starts)])
    action = batch.action[:, rows].transpose(0, 1).flatten(0, 1)
    return imagine_window(model, Carry(h, z), action, [size * len(start) for start in starts])


def _rows(carry: Carry, imagined: Carry, start: Tensor) -> Carry:
    """Reshape states (S B, ...) imagined from rows of a carry (B, T, ...) to (B, S, ...)."""
    shape = (len(start), len(carry.h))  # S = 0 where a window is too short
    h, z = (x.view(*shape, x.shape[-1]).transpose(0, 1) for x in (imagined.h, imagined.z))
    return Carry(h, z)


def _compare(
    name: str,
    model: WorldModel,
    imagined: Imagined | None,
    rollout: Rollout,
    batch: Batch,
    weight: Tensor,
    weights: _TermWeights,
) -> dict[str, Tensor]:
    """Terms ``NAME_depth``, ``NAME_state`` and, if decoded, ``NAME_object`` of imagined states."""
    if imagined is None:
        return {}
    carry, rows, known = imagined
    near = rollout.near[:, rows]
    image = model.decode_depth(carry.features.flatten(0, 1)).view_as(near)
    depth = image_error(image, near, weight[:, rows])
    predicted = model.decode_state(carry.h, carry.z).float()
    state = 0.5 * (predicted - rollout.state[:, rows]).square().mean(-1)
    terms = {
        f"{name}_depth": weights.depth * masked_mean(depth, known),
        f"{name}_state": weights.state * masked_mean(state, known),
    }
    if weights.object > 0:
        error = object_error(model, carry, batch.object[:, rows])
        known = known & batch.object_known[:, rows]
        terms[f"{name}_object"] = weights.object * masked_mean(error, known)
    return terms
