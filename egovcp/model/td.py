"""Q by temporal differences: the return of a row as its reward and what Q thinks of the next row.

    y_t = r_t + gamma (1 - d_t) Q'(h_{t+1}, z_{t+1}, a_{t+1})

a_{t+1} is what the data did there, so that this Q judges the same policy as Monte Carlo returns
do: the random walk, here without a horizon. d_t: a_t ended the episode in failure.
"""

from __future__ import annotations

import copy

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from egovcp.model.carry import Carry
from egovcp.model.losses import Batch, unbroken
from egovcp.model.nets import SplitMlp
from egovcp.model.world_model import WorldModel


class TargetNetwork(nn.Module):
    """A copy of the head of Q that follows it by an exponential moving average.

    Encoder and recurrence are not copied: both heads read the same states.
    """

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        self.head = copy.deepcopy(model.value_head)
        self.requires_grad_(False)

    @torch.no_grad()
    def update(self, model: WorldModel, decay: float) -> None:
        """Move towards the model's head: keep ``decay`` of each weight."""
        for own, new in zip(self.head.parameters(), model.value_head.parameters(), strict=True):
            own.lerp_(new, 1 - decay)


@torch.no_grad()
def td_target(
    model: WorldModel, carry: Carry, batch: Batch, head: SplitMlp | None = None
) -> tuple[Tensor, Tensor]:
    """Targets (B, T) in units of return, and the rows that have one.

    A row has none if it is the last one of its window, or of an episode that the time limit
    ended: nobody knows what came next. The row of a failure needs no next one.

    Args:
        model: asked for Q.
        carry: the filtered states (B, T, ...).
        batch: what was recorded.
        head: of Q'; None: the model's own.
    """
    if head is None:
        head = model.value_head
    later = F.pad(model.value_by(head, carry, batch.action)[:, 1:], (0, 1))
    later = later.masked_fill(batch.terminal_next, 0.0)
    known = F.pad(unbroken(batch, 1), (0, 1)) | batch.terminal_next
    return batch.reward + model.discount * later, batch.valid & known
