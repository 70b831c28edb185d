"""Does D tell which rows are about to end in failure?"""

from __future__ import annotations

from typing import Final, NamedTuple

import torch
from torch import Tensor

from egovcp.model import Batch, WorldModel
from egovcp.model.losses import Rollout

WITHIN: Final = (1, 5, 25)  # rows; 1 is what D is trained for, 25 are a second


class Foretold(NamedTuple):
    """Rows of some episodes, (n,) each."""

    logit: Tensor
    """D's log-odds, on the state that the row's action leads to."""
    ahead: Tensor
    """How many rows from here the failure comes, 1 for this row's action; 0: never."""
    known: Tensor
    """Rows from here on, with this one, of which the outcome is known."""


def foretell(model: WorldModel, batch: Batch, rollout: Rollout) -> Foretold:
    """D on every row, as it is trained: one tick ahead, and asked of an imagined state."""
    logit = model.termination_logit(model.imagine(rollout.carry, batch.action))
    length = batch.valid.sum(1, keepdim=True)
    to_end = length - torch.arange(batch.valid.shape[1], device=length.device)
    fails = (batch.terminal_next & batch.valid).any(1, keepdim=True).expand_as(to_end)
    ahead = torch.where(fails, to_end, 0)
    # After a failure nothing follows; after a time limit nobody knows.
    known = torch.where(fails, torch.iinfo(torch.int64).max, to_end)
    rows = batch.valid
    return Foretold(logit[rows].cpu(), ahead[rows].cpu(), known[rows].cpu())


def termination_scores(
    foretold: list[Foretold],
) -> dict[str, dict[str, float | int | None]]:
    """k -> auc of "fails within k rows" (None without both outcomes), failing, rows."""
    logit, ahead, known = (torch.cat(x) for x in zip(*foretold, strict=True))
    out: dict[str, dict[str, float | int | None]] = {}
    for k in WITHIN:
        usable = known >= k
        failing = ((ahead > 0) & (ahead <= k))[usable]
        out[str(k)] = {
            "auc": auc(logit[usable], failing),
            "failing": int(failing.sum()),
            "rows": int(usable.sum()),
        }
    return out


def auc(score: Tensor, positive: Tensor) -> float | None:
    """The probability that a positive scores above a negative, a tie counting half.

    Args:
        score: (n,).
        positive: (n,) bool.

    Returns:
        Area under the ROC curve, from the ranks (Mann and Whitney); None if either is missing.
    """
    positives = int(positive.sum())
    negatives = positive.numel() - positives
    if positives == 0 or negatives == 0:
        return None
    _, place, count = torch.unique(score, return_inverse=True, return_counts=True)
    last = count.cumsum(0).double()
    rank = (last - (count.double() - 1) / 2)[place]  # from 1; ties share their mean
    above = rank[positive].sum() - positives * (positives + 1) / 2
    return float(above) / (positives * negatives)
