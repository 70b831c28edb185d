"""t-SNE, exact (van der Maaten, Hinton 2008): points in the plane, neighbours kept.

    p_ij = (p_j|i + p_i|j) / 2n,   p_j|i ~ exp(-|x_i - x_j|^2 / 2 s_i^2), s_i from the perplexity
    q_ij ~ 1 / (1 + |y_i - y_j|^2)
    minimise KL(p || q) over y by gradient descent with momentum and gains

Every pair is computed: a few thousand points at most.
"""

from __future__ import annotations

import math
from typing import Final

import torch
from torch import Tensor

_EXAGGERATION: Final = 12.0
_EARLY: Final = 250  # iterations under exaggeration
_BISECTIONS: Final = 64
_LEAST: Final = 1e-12


def tsne(points: Tensor, perplexity: float = 30.0, iterations: int = 750) -> Tensor:
    """(n, d) points -> (n, 2). Deterministic: starts at the first two principal components.

    Args:
        points: n above three times the perplexity; fewer lower the perplexity.
        perplexity: effective number of neighbours.
        iterations: of the descent.
    """
    n = len(points)
    if n < 4:
        return points.new_zeros(n, 2)
    target = _joint(points.double(), min(perplexity, (n - 1) / 3))
    y = _principal(points.double())
    step, gains = torch.zeros_like(y), torch.ones_like(y)
    rate = max(n / _EXAGGERATION / 4, 50.0)
    for i in range(iterations):
        early = i < min(_EARLY, iterations // 3)
        gradient = _gradient(target * (_EXAGGERATION if early else 1.0), y)
        same = gradient.sign() == step.sign()
        gains = torch.where(same, gains * 0.8, gains + 0.2).clamp_min(0.01)
        step = (0.5 if early else 0.8) * step - rate * gains * gradient
        y = y + step
        y = y - y.mean(0)
    return y


def _joint(x: Tensor, perplexity: float) -> Tensor:
    """(n, n) p, symmetric, summing to 1."""
    square = torch.cdist(x, x).square()
    square.fill_diagonal_(math.inf)
    square = square - square.amin(1, keepdim=True)
    wanted = math.log(perplexity)
    low, high = torch.full_like(x[:, :1], -60.0), torch.full_like(x[:, :1], 60.0)
    for _ in range(_BISECTIONS):  # log of 1 / 2 s^2; entropy falls as it grows
        middle = (low + high) / 2
        p = _conditional(square, middle)
        entropy = -(p * p.clamp_min(_LEAST).log()).sum(1, keepdim=True)
        low = torch.where(entropy > wanted, middle, low)
        high = torch.where(entropy > wanted, high, middle)
    p = _conditional(square, (low + high) / 2)
    return ((p + p.T) / (2 * len(x))).clamp_min(_LEAST)


def _conditional(square: Tensor, log_precision: Tensor) -> Tensor:
    weight = torch.exp(-square * log_precision.exp())
    return weight / weight.sum(1, keepdim=True)


def _gradient(p: Tensor, y: Tensor) -> Tensor:
    near = 1 / (1 + torch.cdist(y, y).square())
    near.fill_diagonal_(0.0)
    pull = (p - near / near.sum()) * near  # (n, n)
    return 4 * (pull.sum(1, keepdim=True) * y - pull @ y)


def _principal(x: Tensor) -> Tensor:
    """(n, 2) first two principal components, small; signs are fixed by the largest entry."""
    centred = x - x.mean(0)
    u, s, _ = torch.linalg.svd(centred, full_matrices=False)
    y = u[:, :2] * s[:2]
    y = torch.nn.functional.pad(y, (0, 2 - y.shape[1]))
    sign = y.gather(0, y.abs().argmax(0, keepdim=True)).sign()
    spread = y[:, :1].std().clamp_min(_LEAST)
    placed: Tensor = y * torch.where(sign == 0, 1.0, sign) / spread * 1e-4
    return placed
