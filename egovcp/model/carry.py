"""What the world model remembers from one tick to the next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Carry(NamedTuple):
    """The model's memory: h (..., hidden) and z (..., latent); and what it remembers of a flight.

    Without the latter Q is told of it what h and z say.
    """

    h: Tensor
    z: Tensor
    flight: Tensor | None = None  # (..., `egovcp.model.flight.SIZE`), or its first four numbers

    def map(self, change: Callable[[Tensor], Tensor]) -> Carry:
        """Every part changed in the same way."""
        flight = None if self.flight is None else change(self.flight)
        return Carry(change(self.h), change(self.z), flight)

    def row(self, index: int) -> Carry:
        """That of one robot, (1, ...)."""
        return self.map(lambda x: x[index : index + 1])

    @staticmethod
    def join(carries: Sequence[Carry], how: Callable[[list[Tensor]], Tensor]) -> Carry:
        """Equal parts of several joined in the same way."""
        flights = [c.flight for c in carries if c.flight is not None]
        joined = how(flights) if flights else None
        return Carry(how([c.h for c in carries]), how([c.z for c in carries]), joined)

    @property
    def features(self) -> Tensor:
        return torch.cat([self.h, self.z], -1)
