"""What all candidate plans of a robot share: the sums of first layers, computed once a plan."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from egovcp.model import Carry, WorldModel
from egovcp.model.nets import SplitMlp


class Root(NamedTuple):
    """(E, 1, ...) for E robots."""

    h: Tensor
    mix: Tensor  # sums of the first layer that leads to the GRU
    gates: Tensor  # sums of the GRU's gates
    values: tuple[Tensor, ...]  # sums of the first layers of Q, two for a head that is told


def root_of(model: WorldModel, carry: Carry) -> Root:
    """From the robots' states (E, ...)."""
    carry = model.spread(carry)
    told = None if model.passing_value_head is None else model.passing(carry)
    values: list[Tensor] = []
    for head in model.q_heads:
        reduce = head.state.reduce
        values.append(_but_action(head.state.mlp, *(carry if reduce is None else [reduce(*carry)])))
        if head.passing is not None and told is not None:
            values.append(_but_action(head.passing, told))
    mix, gates = model.mix.parts[0](carry.z), model.gru.project.parts[1](carry.h)
    return Root(carry.h, mix, gates, tuple(values))


def _but_action(mlp: SplitMlp, *state: Tensor) -> Tensor:
    """The first layer's sums without those of its last input, the action."""
    *parts, _ = mlp.first.parts
    return torch.stack([part(x) for part, x in zip(parts, state, strict=True)]).sum(0)
