"""Open-loop predictions picked for pictures: what was seen, and what was foreseen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp.model import Batch, Carry, WorldModel
from egovcp.model.losses import Rollout, moving_pixels
from egovcp_train.heldout.episodes import Recorded
from egovcp_train.heldout.open_loop import CONTEXT, HORIZONS

STRIP: Final = tuple(range(0, max(HORIZONS) + 1, 2))  # horizons of the pictures; 0 is filtered
KEPT: Final = 3  # strips per task


class Strip(NamedTuple):
    """One prediction."""

    interest: float
    start: int
    """Row of the last picture that was seen."""
    seen: NDArray[np.float32]
    """(len(STRIP), 48, 64) nearness."""
    foreseen: NDArray[np.float32]
    """(len(STRIP), 48, 64) nearness."""


def best(found: Sequence[Strip]) -> list[Strip]:
    """The `KEPT` most interesting ones."""
    return sorted(found, key=lambda strip: -strip.interest)[:KEPT]


def strips(model: WorldModel, episodes: Recorded, rollout: Rollout) -> list[Strip]:
    """The most interesting predictions of a group of episodes, at most one each.

    One starts before the rows in which most pixels move.
    """
    start, interest = _starts(episodes.batch, rollout.near)
    order = torch.argsort(-interest, stable=True)[:KEPT]
    return [
        _strip(model, episodes, rollout, int(b), int(start[b]), float(interest[b]))
        for b in order
        if interest[b] >= 0
    ]


def _starts(batch: Batch, near: Tensor) -> tuple[Tensor, Tensor]:
    """(B,) row of the start, and (B,) its interest, negative where the episode is too short."""
    ahead = max(HORIZONS)
    latest = batch.valid.sum(1) - 1 - ahead
    moving = (moving_pixels(near, 0.04).sum((-2, -1)) * batch.valid).cumsum(1)
    window = torch.full_like(moving, -1.0)
    window[:, :-ahead] = moving[:, ahead:] - moving[:, :-ahead]
    rows = torch.arange(window.shape[1], device=window.device)
    possible = (rows >= CONTEXT - 1) & (rows <= latest[:, None])
    window = window.masked_fill(~possible, -1.0)
    interest, start = window.max(1)
    return start, interest


def _strip(
    model: WorldModel, episodes: Recorded, rollout: Rollout, b: int, s: int, interest: float
) -> Strip:
    carry = rollout.carry.map(lambda x: x[b, s][None])
    states = [carry]
    for k in range(max(HORIZONS)):
        states.append(model.imagine(states[-1], episodes.batch.action[b, s + k][None]))
    shown = Carry.join([states[k] for k in STRIP], torch.cat)
    foreseen = model.decode_near(shown).clamp(0.0, 1.0)
    seen = rollout.near[b, [s + k for k in STRIP]]
    return Strip(interest, s, seen.cpu().numpy(), foreseen.cpu().numpy())
