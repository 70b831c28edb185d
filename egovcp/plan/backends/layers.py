"""The layers that a planning network is made of, as any arithmetic must provide them.

A layer's inputs are of two kinds. *Wide* ones (h, and what a hidden layer gives to the next) carry
nearly all of the arithmetic, in whatever form the arithmetic likes best: `R`, made by it and read
by nobody else. *Narrow* ones (z, the action, and what is told of a ball) are few and stay float32:
between two actions that are worth comparing there may be less than a byte can tell.

What all candidates share is a sum that is ready when they come: ``add``.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from egovcp.model.nets import GruCell, SplitMlp


class HiddenLayer(NamedTuple):
    """Weights of Linear + LayerNorm + SiLU, and of the Linear on top if it is the last one."""

    wide: Tensor | None  # (units, K)
    wide_is_state: bool  # h, or else a hidden layer
    narrow: Tensor | None  # (units, k)
    norm: nn.LayerNorm
    last: nn.Linear | None


class GruLayer(NamedTuple):
    """Weights of the recurrence, whose gates are (reset, candidate, update)."""

    wide_x: Tensor  # (3 hidden, units)
    wide_h: Tensor  # (3 hidden, hidden)
    gamma: Tensor  # (3 hidden,)
    beta: Tensor  # (3 hidden,) with the bias of the update gate
    epsilon: float


class Hidden[R](Protocol):
    """One hidden layer."""

    def between(self, wide: R | None, narrow: Tensor | None, add: Tensor | None) -> R:
        """The layer's outputs, for a further layer."""
        ...

    def last(self, wide: R | None, narrow: Tensor | None, add: Tensor | None) -> Tensor:
        """(..., outputs) of the linear layer on top."""
        ...


class Recurrence[R](Protocol):
    """The GRU."""

    def __call__(self, x: R, wide_h: R | None, add: Tensor | None, h: Tensor) -> tuple[Tensor, R]:
        """The next h, as numbers and as a wide input; the part of h comes from ``wide_h`` or is
        in ``add``."""
        ...


class Linear(Protocol):
    """A linear layer of few outputs on numbers."""

    def __call__(self, h: Tensor, z: Tensor) -> Tensor:
        """(..., outputs)."""
        ...


class Arithmetic[R](Protocol):
    """Makes layers."""

    def hidden(self, layer: HiddenLayer) -> Hidden[R]: ...

    def recurrence(self, layer: GruLayer) -> Recurrence[R]: ...

    def linear(self, h: Tensor, z: Tensor) -> Linear:
        """From the weights (outputs, hidden) and (outputs, latent)."""
        ...


def weight_of(linear: nn.Module) -> Tensor:
    """The weight (outputs, inputs) of a linear layer."""
    assert isinstance(linear, nn.Linear)
    return linear.weight.detach()


def gru_layer(cell: GruCell) -> GruLayer:
    """The weights of the recurrence."""
    x, h = (weight_of(part) for part in cell.project.parts)
    beta = cell.norm.bias.detach().clone()
    beta[2 * len(beta) // 3 :] += cell.update_bias
    return GruLayer(x, h, cell.norm.weight.detach(), beta, cell.norm.eps)


def hidden_layers(
    mlp: SplitMlp, first_is_state: bool, outputs: int | None = None
) -> list[HiddenLayer]:
    """The layers of a network.

    Args:
        mlp: its first input is h if ``first_is_state``; all others are narrow.
        first_is_state: see there.
        outputs: how many of its last layer's outputs are wanted; None: all.
    """
    weights = [weight_of(part) for part in mlp.first.parts]
    wide = weights.pop(0) if first_is_state else None
    narrow = torch.cat(weights, 1) if weights else None
    *between, last = (m for m in mlp.rest if isinstance(m, nn.Linear))
    norms = [m for m in mlp.rest if isinstance(m, nn.LayerNorm)]
    tops = [None] * len(between) + [first_outputs(last, outputs)]
    layers = [HiddenLayer(wide, True, narrow, norms[0], tops[0])]
    for linear, norm, top in zip(between, norms[1:], tops[1:], strict=True):
        layers.append(HiddenLayer(linear.weight.detach(), False, None, norm, top))
    return layers


def first_outputs(linear: nn.Linear, count: int | None) -> nn.Linear:
    """A linear layer's first ``count`` outputs."""
    if count is None:
        return linear
    part = nn.Linear(linear.in_features, count, device=linear.weight.device)
    with torch.no_grad():
        part.weight.copy_(linear.weight[:count])
        part.bias.copy_(linear.bias[:count])
    return part
