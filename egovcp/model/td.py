"""Q by temporal differences: the return of a row as its reward and what Q thinks of the next row.

    y_t = r_t + gamma (1 - d_t) Q'(h_{t+1}, z_{t+1}, a_{t+1})

a_{t+1} is what the data did there, so that this Q judges the same policy as Monte Carlo returns
do: the random walk, here without a horizon. d_t: a_t ended the episode in failure.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from egovcp.model.carry import Carry
from egovcp.model.losses import Batch, unbroken
from egovcp.model.nets import ValueHead
from egovcp.model.world_model import QHeads, WorldModel


class SlowHeads(nn.Module):
    """A copy of Q's heads that follows them slowly: targets that run away from their own fit
    have time to settle. Encoder and memory are not copied; both Qs read the same states."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        self._states = nn.ModuleList(copy.deepcopy(head) for head in model.q_heads.states)
        self._passing = copy.deepcopy(model.q_heads.passing)
        self.requires_grad_(False)

    @property
    def heads(self) -> QHeads:
        """To be asked through `WorldModel.value`."""
        states: list[ValueHead] = list(self._states)  # type: ignore[arg-type]
        return QHeads(tuple(states), self._passing)

    @torch.no_grad()
    def follow(self, model: WorldModel, decay: float) -> None:
        """Keep ``decay`` of what this is, and take the rest from the model."""
        own = [*_parameters(self.heads)]
        torch._foreach_lerp_(own, [*_parameters(model.q_heads)], 1 - decay)


def _parameters(heads: QHeads) -> Iterator[Tensor]:
    for part in heads.parts:
        yield from part.parameters()


@torch.no_grad()
def td_target(
    model: WorldModel, carry: Carry, batch: Batch, heads: QHeads | None = None
) -> tuple[Tensor, Tensor]:
    """Targets (B, T) in units of return, and the rows that have one.

    A row has none if it is the last one of its window, or of an episode that the time limit
    ended: nobody knows what came next. The row of a failure needs no next one.

    Args:
        model: asked for Q.
        carry: the filtered states (B, T, ...).
        batch: what was recorded.
        heads: those that Q' is; None: the model's own.
    """
    if heads is None:
        heads = model.q_heads
    later = F.pad(model.value_by(heads, carry, batch.action)[:, 1:], (0, 1))
    later = later.masked_fill(batch.terminal_next, 0.0)
    known = F.pad(unbroken(batch, 1), (0, 1)) | batch.terminal_next
    return batch.reward + model.discount * later, batch.valid & known
