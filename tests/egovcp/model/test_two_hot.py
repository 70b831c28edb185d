"""A number as weights of two bins: nothing is lost, and means stay means."""

import pytest
import torch

from egovcp.model import two_hot

NUMBERS = [0.0, 0.03, -0.7, 1.0, 5.5, -20.0, 50.0]


def test_a_number_is_the_mean_of_its_encoding() -> None:
    x = torch.tensor(NUMBERS)
    weights = two_hot.encode(x)
    torch.testing.assert_close(weights @ two_hot.bins(x), x)
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(x)))
    assert (weights >= 0).all()
    assert ((weights > 0).sum(-1) <= 2).all()


@pytest.mark.parametrize(("x", "index"), [(1e6, -1), (-1e6, 0)])
def test_what_lies_beyond_the_bins_counts_as_the_outermost(x: float, index: int) -> None:
    assert two_hot.encode(torch.tensor([x]))[0, index] == 1.0


def test_a_distribution_fitted_to_numbers_says_their_mean() -> None:
    """As a squared error does; the symlog alone would not."""
    targets = torch.tensor([-3.0, 0.1, 0.2, 9.0])
    logits = torch.zeros(two_hot.BINS, requires_grad=True)
    optimizer = torch.optim.Adam([logits], lr=0.5)
    for _ in range(400):
        optimizer.zero_grad()
        two_hot.cross_entropy(logits.expand(4, -1), targets).mean().backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    assert two_hot.decode(logits).item() == pytest.approx(targets.mean().item(), abs=0.05)


def test_equal_log_odds_say_zero() -> None:
    """So that a head that starts at zero starts at the mean return."""
    assert two_hot.decode(torch.zeros(3, two_hot.BINS)).abs().max() < 1e-5
