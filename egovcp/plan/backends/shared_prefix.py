"""Sums of first layers that all candidate plans of a robot share, computed once a plan."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from egovcp.model import Carry, WorldModel
from egovcp.model.networks import SplitMlp


class SharedPrefix(NamedTuple):
    """(E, 1, ...) for E robots."""

    h: Tensor
    mix: Tensor  # of the layer before the GRU, from z
    gates: Tensor  # of the GRU's gates, from h
    value: Tensor  # of the value head, from h and z
    reward: Tensor | None  # of the reward head, from h and z; None: the model has none


def shared_prefix(model: WorldModel, carry: Carry) -> SharedPrefix:
    """From the robots' states (E, ...)."""
    carry = model.expand_candidates(carry)
    reward = None if model.reward_head is None else _state_sums(model.reward_head, carry)
    return SharedPrefix(
        carry.h,
        model.mix.parts[0](carry.z),
        model.gru.project.parts[1](carry.h),
        _state_sums(model.value_head, carry),
        reward,
    )


def _state_sums(head: SplitMlp, carry: Carry) -> Tensor:
    """The first layer of a head over (h, z, a), without the part of the action."""
    of_h, of_z, _ = head.first.parts
    sums: Tensor = of_h(carry.h) + of_z(carry.z)
    return sums
