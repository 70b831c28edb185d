"""Q by temporal differences: the return of a row as its reward and what Q thinks of the next row.

    y_t = r_t + gamma (1 - d_t) Q'(h_{t+1}, z_{t+1}, a_{t+1})

a_{t+1} is what the data did there, so that this Q judges the same policy as Monte Carlo returns
do: the random walk, here without a horizon. d_t: a_t ended the episode in failure.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from egovcp.model.losses import Batch, unbroken
from egovcp.model.nets import SplitMlp, ValueHead
from egovcp.model.world_model import Carry, QHead, WorldModel


class SlowHeads(nn.Module):
    """A copy of Q's heads that follows them slowly: targets that run away from their own fit
    have time to settle. Encoder and memory are not copied; both Qs read the same states."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__()
        self._state = nn.ModuleList(copy.deepcopy(head.state) for head in model.q_heads)
        told = [head.passing for head in model.q_heads if head.passing is not None]
        self._passing = nn.ModuleList(copy.deepcopy(part) for part in told)
        self.requires_grad_(False)

    @property
    def heads(self) -> list[QHead]:
        """To be asked through `WorldModel.value`."""
        state: list[ValueHead] = list(self._state)  # type: ignore[arg-type]
        passing: list[SplitMlp | None] = list(self._passing)  # type: ignore[arg-type]
        return [QHead(*parts) for parts in zip(state, passing or [None] * len(state), strict=True)]

    @torch.no_grad()
    def follow(self, model: WorldModel, decay: float) -> None:
        """Keep ``decay`` of what this is, and take the rest from the model."""
        own = [*_parameters(self.heads)]
        torch._foreach_lerp_(own, [*_parameters(model.q_heads)], 1 - decay)


def _parameters(heads: Sequence[QHead]) -> Iterator[Tensor]:
    for part in (part for head in heads for part in head if part is not None):
        yield from part.parameters()


@torch.no_grad()
def td_target(
    model: WorldModel, carry: Carry, batch: Batch, heads: Sequence[QHead] | None = None
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
