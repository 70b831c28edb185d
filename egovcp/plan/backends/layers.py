"""The layers of a planning network, extracted from a world model.

*Wide* inputs of a layer (h, and the outputs of a hidden layer) need nearly all of the arithmetic;
*narrow* ones (z and the action) are few.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from egovcp.model.networks import GruCell, SplitMlp


class HiddenLayer(NamedTuple):
    """Weights of Linear + LayerNorm + SiLU, and of the Linear on top if it is the last one."""

    wide: Tensor | None  # (units, K)
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


def norms_of(mlp: SplitMlp) -> list[nn.LayerNorm]:
    """The normalisation of each hidden layer."""
    return [m for m in mlp.rest if isinstance(m, nn.LayerNorm)]


def linears_of(mlp: SplitMlp) -> list[nn.Linear]:
    """The linear layers after the first one; the last is the one on top."""
    return [m for m in mlp.rest if isinstance(m, nn.Linear)]


def hidden_layers(mlp: SplitMlp, outputs: int | None = None) -> list[HiddenLayer]:
    """The layers of a network.

    Args:
        mlp: its first input is h; all others are narrow.
        outputs: how many of its last layer's outputs are wanted; None: all.
    """
    wide, *weights = map(weight_of, mlp.first.parts)
    narrow = torch.cat(weights, 1) if weights else None
    *between, last = linears_of(mlp)
    norms = norms_of(mlp)
    tops = [None] * len(between) + [first_outputs(last, outputs)]
    layers = [HiddenLayer(wide, narrow, norms[0], tops[0])]
    for linear, norm, top in zip(between, norms[1:], tops[1:], strict=True):
        layers.append(HiddenLayer(linear.weight.detach(), None, norm, top))
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
