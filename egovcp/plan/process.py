"""The action process of the data: a random walk in the box, folded back at its walls."""

from __future__ import annotations

import torch
from torch import Tensor


def reflect(x: Tensor) -> Tensor:
    """Fold values within one box length outside [-1, 1] back inside, as the data does."""
    return 2.0 * x.clamp(-1.0, 1.0) - x


def walk(start: Tensor, deltas: Tensor, eta: float) -> Tensor:
    """Actions (..., N, 7) of the data's process from ``start`` (..., 7) by ``deltas``."""
    actions = []
    action = start
    for delta in deltas.unbind(-2):
        action = reflect(action + eta * delta)
        actions.append(action)
    return torch.stack(actions, -2)


def shift(deltas: Tensor) -> Tensor:
    """Drop the executed first step (E, N, 7) and stand still at the end: the warm start."""
    return torch.cat([deltas[:, 1:], torch.zeros_like(deltas[:, :1])], 1)
