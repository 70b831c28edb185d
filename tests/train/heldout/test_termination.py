"""The area under the curve, and which rows it is computed on."""

import itertools

import pytest
import torch
from torch import Tensor

from egovcp.model import PRESETS, Carry, WorldModel
from egovcp.model.losses import filter_sequence
from egovcp.testing import random_batch
from egovcp_train.heldout.termination import Foretold, auc, foretell, termination_scores


def _by_pairs(score: Tensor, positive: Tensor) -> float:
    pairs = list(itertools.product(score[positive].tolist(), score[~positive].tolist()))
    return sum(1.0 if p > n else 0.5 if p == n else 0.0 for p, n in pairs) / len(pairs)


@pytest.mark.parametrize("levels", [2, 5, 1000])
def test_the_auc_counts_pairs(levels: int) -> None:
    rng = torch.Generator().manual_seed(levels)
    score = torch.randint(levels, (200,), generator=rng).float()
    positive = torch.rand(200, generator=rng) < 0.2
    assert auc(score, positive) == pytest.approx(_by_pairs(score, positive), abs=1e-12)


def test_perfect_inverted_and_blind_scores() -> None:
    positive = torch.tensor([False, False, True, True])
    assert auc(torch.tensor([0.0, 1.0, 2.0, 3.0]), positive) == 1.0
    assert auc(torch.tensor([3.0, 2.0, 1.0, 0.0]), positive) == 0.0
    assert auc(torch.zeros(4), positive) == 0.5


@pytest.mark.parametrize("value", [True, False])
def test_without_both_outcomes_there_is_no_auc(value: bool) -> None:
    assert auc(torch.rand(5), torch.full((5,), value)) is None
    assert auc(torch.zeros(0), torch.zeros(0, dtype=torch.bool)) is None


class _Clock(WorldModel):
    """Counts the ticks in h; D's log-odds are that count."""

    def advance(self, carry: Carry, action: Tensor, is_first: Tensor) -> Tensor:
        return carry.h.masked_fill(is_first[:, None], -1.0) + 1.0

    def imagine(self, carry: Carry, action: Tensor) -> Carry:
        return Carry(carry.h + 1.0, carry.z)

    def termination_logit(self, carry: Carry) -> Tensor:
        return carry.h[..., 0]


def _foretold() -> Foretold:
    """Two episodes of 40 rows, one of which fails at row 29; the other meets its time limit."""
    batch = random_batch(2, 40)
    valid, fails = batch.valid.clone(), batch.terminal_next.clone()
    valid[0, 30:] = False
    fails[0, 29] = True
    batch = batch._replace(valid=valid, terminal_next=fails)
    model = _Clock(PRESETS["debug"])
    with torch.no_grad():
        return foretell(model, batch, filter_sequence(model, batch, sample=False))


def test_a_row_is_judged_by_the_rows_that_follow_it() -> None:
    foretold = _foretold()
    scores = termination_scores([foretold])
    assert (scores["1"]["failing"], scores["1"]["rows"]) == (1, 70)
    assert (scores["5"]["failing"], scores["5"]["rows"]) == (5, 30 + 36)
    assert (scores["25"]["failing"], scores["25"]["rows"]) == (25, 30 + 16)
    # D grows with the ticks: rows 0 to 28 and 0 to 29 lie below the failing one, as does no other.
    assert scores["1"]["auc"] == pytest.approx((29 + 29 + 0.5) / 69)
    late = torch.cat([torch.arange(25.0), torch.arange(36.0)])
    pairs = (torch.arange(25.0, 30.0)[:, None] > late).double()
    pairs += 0.5 * (torch.arange(25.0, 30.0)[:, None] == late)
    assert scores["5"]["auc"] == pytest.approx(float(pairs.mean()))


def test_groups_are_judged_together() -> None:
    one = _foretold()
    assert termination_scores([one, one])["5"]["failing"] == 10
    assert termination_scores([one, one])["5"]["auc"] == pytest.approx(
        termination_scores([one])["5"]["auc"]
    )
