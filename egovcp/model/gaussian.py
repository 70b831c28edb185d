"""Diagonal Gaussians of the stochastic state."""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from egovcp.model.data_parallel import row_noise

SHIFT: Final = 0.54  #: softplus of it is 1


class Gaussian(NamedTuple):
    """A diagonal Gaussian: mean and standard deviation, (..., Z)."""

    mean: Tensor
    std: Tensor

    @classmethod
    def from_logits(cls, logits: Tensor, min_std: float) -> Gaussian:
        """(..., 2Z) network output -> Gaussian whose deviation is 1 at zero logits."""
        mean, raw = logits.float().chunk(2, -1)
        return cls(mean, F.softplus(raw + SHIFT) + min_std)

    def sample(self, generator: torch.Generator | None = None) -> Tensor:
        """One reparametrised draw."""
        noise = row_noise(self.mean.shape, generator, self.mean.device)
        return self.mean + self.std * noise

    def detach(self) -> Gaussian:
        return Gaussian(self.mean.detach(), self.std.detach())


def kl_divergence(q: Gaussian, p: Gaussian) -> Tensor:
    """KL(q || p) per dimension, (..., Z), in nats."""
    ratio = (q.std / p.std).square()
    distance = ((q.mean - p.mean) / p.std).square()
    return 0.5 * (ratio + distance - 1.0 - ratio.log())
