"""Action sequences of candidates: a random walk in the box, or steps towards a target."""

from __future__ import annotations

import torch
from torch import Tensor


def reflect(x: Tensor) -> Tensor:
    """Fold values within one box length outside [-1, 1] back inside, as the data does."""
    return 2.0 * x.clamp(-1.0, 1.0) - x


def random_walk(start: Tensor, deltas: Tensor, eta: float) -> Tensor:
    """Actions (..., N, 7) of a random walk from ``start`` (..., 7) by ``deltas``."""
    actions = []
    action = start
    for delta in deltas.unbind(-2):
        action = reflect(action + eta * delta)
        actions.append(action)
    return torch.stack(actions, -2)


def target_steps(start: Tensor, deltas: Tensor, eta: float) -> Tensor:
    """Steps (..., N, 7) that move from ``start`` (..., 7) to one target at rate ``eta``, then stop.

    The target is where ``deltas`` (..., N, 7) add up to, reflected into the box. Steps that are
    already of this kind are returned unchanged.
    """
    target = reflect((start + eta * deltas.sum(-2)).clamp(-3.0, 3.0))
    far = ((target - start) / eta)[..., None, :]
    ticks = torch.arange(deltas.shape[-2], dtype=far.dtype, device=far.device)[:, None]
    return (far.abs() - ticks).clamp(0.0, 1.0) * far.sign()


def shift(deltas: Tensor) -> Tensor:
    """Drop the executed first step (E, N, 7) and stand still at the end: the warm start."""
    return torch.cat([deltas[:, 1:], torch.zeros_like(deltas[:, :1])], 1)
