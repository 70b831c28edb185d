"""The training objective: equation 6, the sum of its terms."""

from __future__ import annotations

import torch
from torch import Tensor

from egovcp.model import losses
from egovcp.model.foresight import autoregressive_losses, foresight_losses
from egovcp.model.losses import Batch
from egovcp.model.outcomes import value_and_termination_losses
from egovcp.model.world_model import QHeads, WorldModel


def world_model_loss(
    model: WorldModel,
    batch: Batch,
    generator: torch.Generator | None = None,
    heads: QHeads | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Total loss of equation 6 and its terms (scalars, detached).

    Args:
        model: the world model.
        batch: windows.
        generator: of the latent noise and of the drawn rows; None: torch's own.
        heads: of Q, for its TD target (`egovcp.model.td`); None: the model's own.
    """
    config = model.config.loss
    rollout = losses.filter_sequence(model, batch, generator=generator)
    weight = losses.pixel_weights(rollout.near, batch, model)
    depth = losses.depth_loss(model, rollout, batch.valid, weight, config.decode_every, generator)
    terms = {
        "depth": config.depth * depth,
        "motion": config.motion * losses.motion_loss(model, rollout, batch),
        "passing": config.passing * losses.passing_loss(model, rollout, batch),
        "state": config.state * losses.state_loss(model, rollout, batch),
    }
    if model.config.dynamics == "joint":
        terms |= losses.kl_losses(rollout, batch.valid, config)
    else:
        terms |= autoregressive_losses(model, rollout, batch, weight, generator)
    terms |= value_and_termination_losses(model, rollout, batch, config, heads)
    terms |= foresight_losses(model, rollout, batch, weight, generator)
    total = torch.stack(list(terms.values())).sum()
    return total, {f"loss/{name}": term.detach() for name, term in terms.items()}
