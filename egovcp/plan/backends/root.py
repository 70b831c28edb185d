"""What all candidate plans of a robot share: the sums of first layers, computed once a plan."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from egovcp.model import Carry, WorldModel, flight
from egovcp.model.nets import SplitMlp, ValueHead
from egovcp.model.world_model import PASSING_UNIT


class Root(NamedTuple):
    """(E, 1, ...) for E robots."""

    h: Tensor
    mix: Tensor  # sums of the first layer that leads to the GRU
    gates: Tensor  # sums of the GRU's gates
    values: tuple[Tensor, ...]  # sums of the first layers of `heads_of`
    passing: Tensor | None  # and of the part that they share
    flight: Tensor | None  # what is remembered of a flight

    def told(self, k: int) -> Tensor | None:
        """(E, 1, 4) what Q is told of it at step k, whatever the robot does meanwhile."""
        if self.flight is None:
            return None
        return flight.told(flight.later(self.flight, k), PASSING_UNIT)


def told_along(memory: Tensor, steps: int) -> Tensor:
    """(steps, 4) `Root.told` at all of them, of a flight remembered as (1, n)."""
    ticks = torch.arange(steps, device=memory.device)[:, None]
    return flight.told(flight.told_later(memory.expand(steps, -1), ticks), PASSING_UNIT)


def heads_of(model: WorldModel) -> list[ValueHead]:
    """Q's heads, and after them the one of the reward, if the model has one."""
    reward = model.reward_head
    return [*model.q_heads.states, *([] if reward is None else [reward])]


def root_of(model: WorldModel, carry: Carry) -> Root:
    """From the robots' states (E, ...)."""
    carry = model.spread(carry)
    state = (carry.h, carry.z)
    values: list[Tensor] = []
    for head in heads_of(model):
        reduce = head.reduce
        values.append(_but_action(head.mlp, *(state if reduce is None else [reduce(*state)])))
    shared = model.q_heads.passing
    passing = None if shared is None else _but_action(shared, model.passing(carry))
    mix, gates = model.mix.parts[0](carry.z), model.gru.project.parts[1](carry.h)
    followed = None if shared is None else carry.flight
    return Root(carry.h, mix, gates, tuple(values), passing, followed)


def _but_action(mlp: SplitMlp, *state: Tensor) -> Tensor:
    """The first layer's sums without those of its last input, the action."""
    *parts, _ = mlp.first.parts
    return torch.stack([part(x) for part, x in zip(parts, state, strict=True)]).sum(0)
