"""The recurrent state of the world model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Carry(NamedTuple):
    """Recurrent state: deterministic h (..., hidden) and stochastic z (..., latent)."""

    h: Tensor
    z: Tensor

    def map(self, function: Callable[[Tensor], Tensor]) -> Carry:
        """Apply a function to h and to z."""
        return Carry(function(self.h), function(self.z))

    def row(self, index: int) -> Carry:
        """The state of one robot, with a leading dimension of 1."""
        return self.map(lambda x: x[index : index + 1])

    @staticmethod
    def join(carries: Sequence[Carry], function: Callable[[list[Tensor]], Tensor]) -> Carry:
        """Combine several states, for example by `torch.stack`."""
        return Carry(function([c.h for c in carries]), function([c.z for c in carries]))

    @property
    def features(self) -> Tensor:
        """h and z concatenated, (..., hidden + latent)."""
        return torch.cat([self.h, self.z], -1)
