"""The two-hot encoding keeps the mean of numbers."""

import pytest
import torch

from egovcp.model import value

NUMBERS = [0.0, 0.03, -0.7, 1.0, 5.5, -20.0, 50.0]


def test_encoding_keeps_the_mean() -> None:
    x = torch.tensor(NUMBERS)
    weights = value.two_hot(x)
    torch.testing.assert_close(weights @ value.bin_values(x.device), x)
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(x)))
    assert (weights >= 0).all()
    assert ((weights > 0).sum(-1) <= 2).all()


@pytest.mark.parametrize(("x", "index"), [(1e6, -1), (-1e6, 0)])
def test_values_beyond_the_bins_are_clipped(x: float, index: int) -> None:
    assert value.two_hot(torch.tensor([x]))[0, index] == 1.0


def test_a_fitted_distribution_has_the_mean_of_the_targets() -> None:
    """Unlike a plain regression of the symlog."""
    targets = torch.tensor([-3.0, 0.1, 0.2, 9.0])
    logits = torch.zeros(value.BINS, requires_grad=True)
    optimizer = torch.optim.Adam([logits], lr=0.5)
    for _ in range(400):
        optimizer.zero_grad()
        value.error(logits.expand(4, -1), targets, "two_hot").mean().backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    assert value.read(logits, "two_hot").item() == pytest.approx(targets.mean().item(), abs=0.05)


def test_zero_logits_have_the_value_zero() -> None:
    """A head initialised to zero predicts the mean return."""
    assert value.read(torch.zeros(3, value.BINS), "two_hot").abs().max() < 1e-5
