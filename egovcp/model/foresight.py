"""What is foreseen several ticks ahead without looking, compared with what was then recorded.

Equation 8 asks the prior to be right one tick ahead. An error of the path that is nothing after
one tick is a ball's width after eight. So states are also imagined over many ticks, from some
rows of a window and with the recorded actions, and the decoders are asked about those.
"""

from __future__ import annotations

import torch
from torch import Tensor

from egovcp.model.losses import Batch, Rollout, masked_mean, unbroken
from egovcp.model.world_model import Carry, WorldModel


def foresight_losses(
    model: WorldModel,
    rollout: Rollout,
    batch: Batch,
    weight: Tensor,
    generator: torch.Generator | None = None,
) -> dict[str, Tensor]:
    """Picture and proprioception of states imagined ``foresight_ahead`` ticks ahead.

    Args:
        model: the world model.
        rollout: the filtered batch.
        batch: what was recorded.
        weight: (B, T, H, W) of the pixels.
        generator: draws the first row from which is imagined.
    """
    config = model.config.loss
    length = batch.valid.shape[1]
    ahead = [k for k in config.foresight_ahead if k < length]
    if not (ahead and (config.foresight_depth or config.foresight_state)):
        return {}
    device = batch.state.device
    every = min(config.foresight_every, length - min(ahead))
    first = int(torch.randint(every, (), generator=generator, device=device))
    start = torch.arange(first, length - min(ahead), every, device=device)
    carry = Carry(rollout.carry.h[:, start], rollout.carry.z[:, start])
    carries: list[Carry] = []
    rows: list[Tensor] = []
    known: list[Tensor] = []
    for k in range(1, max(ahead) + 1):
        start = start[start + k < length]
        carry = Carry(carry.h[:, : len(start)], carry.z[:, : len(start)])
        carry = model.imagine(carry, batch.action[:, start + k - 1])
        if k in ahead:
            carries.append(carry)
            rows.append(start + k)
            known.append(unbroken(batch, k)[:, start])
    seen = Carry(*(torch.cat(parts, 1) for parts in zip(*carries, strict=True)))
    return _compare(model, seen, rollout, weight, torch.cat(rows), torch.cat(known, 1))


def _compare(
    model: WorldModel,
    seen: Carry,
    rollout: Rollout,
    weight: Tensor,
    rows: Tensor,
    known: Tensor,
) -> dict[str, Tensor]:
    """Errors of imagined states (B, S, ...) against the rows (S,) that they stand for."""
    config = model.config.loss
    near = rollout.near[:, rows]
    image = model.picture(seen.flat()).view_as(near)
    picture = (0.5 * weight[:, rows] * (image - near).square()).mean((-2, -1))
    state = 0.5 * (model.decode_state(*seen).float() - rollout.state[:, rows]).square().mean(-1)
    return {
        "foresight_depth": config.foresight_depth * masked_mean(picture, known),
        "foresight_state": config.foresight_state * masked_mean(state, known),
    }
