"""The latent state of the world model: the recurrent carry and its diagonal Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

SHIFT: Final = 0.54  #: softplus(SHIFT) = 1


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


class Gaussian(NamedTuple):
    """A diagonal Gaussian: mean and standard deviation, (..., Z)."""

    mean: Tensor
    std: Tensor

    @classmethod
    def from_logits(cls, logits: Tensor, min_std: float) -> Gaussian:
        """Network output (..., 2Z) -> Gaussian; its std is 1 + min_std at zero logits."""
        mean, raw = logits.float().chunk(2, -1)
        return cls(mean, F.softplus(raw + SHIFT) + min_std)

    def detach(self) -> Gaussian:
        """The same without gradient."""
        return Gaussian(self.mean.detach(), self.std.detach())


def kl_divergence(q: Gaussian, p: Gaussian) -> Tensor:
    """KL(q || p) per dimension, (..., Z), in nats."""
    ratio = (q.std / p.std).square()
    distance = ((q.mean - p.mean) / p.std).square()
    return 0.5 * (ratio + distance - 1.0 - ratio.log())
