"""From what the heads of the world model say along plans to J, for every packed backend."""

from __future__ import annotations

import torch
from torch import Tensor

from egovcp.model import WorldModel, value
from egovcp.plan.config import PlannerConfig


def q_of(model: WorldModel, config: PlannerConfig, outputs: Tensor) -> Tensor:
    """Q in units of return from the heads' outputs (..., heads, width)."""
    each = value.read(outputs, model.config.value_loss)
    if each.shape[-1] == 1:
        q = each[..., 0]
    else:
        q = each.mean(-1) if config.ensemble == "mean" else each.amin(-1)
    return torch.addcmul(model.return_mean, q, model.return_std)


def noise_of(
    model: WorldModel, config: PlannerConfig, horizon: int, generator: torch.Generator | None
) -> Tensor | None:
    """Noise (horizon - 1, latent) of the imagined states under ``latent=sample``."""
    if config.latent == "mean":
        return None
    size, device = (model.config.latent,), model.state_mean.device
    drawn = [torch.randn(size, generator=generator, device=device) for _ in range(horizon - 1)]
    return torch.stack(drawn) if drawn else None
