"""Calibration against numpy's."""

import numpy as np
import pytest
import torch

from egovcp_train.heldout.calibration import calibration


def test_slope_bias_and_r2_are_those_of_a_polynomial_fit() -> None:
    rng = np.random.default_rng(0)
    target = rng.normal(2.0, 3.0, 500)
    value = 0.4 * target + rng.normal(0.3, 1.0, 500)
    found = calibration(torch.tensor(value), torch.tensor(target))
    slope, _ = np.polyfit(value, target, 1)
    assert found["slope"] == pytest.approx(slope)
    assert found["bias"] == pytest.approx(value.mean() - target.mean())
    assert found["r2"] == pytest.approx(1 - ((value - target) ** 2).mean() / target.var())
    assert found["rows"] == 500


def test_a_perfect_q() -> None:
    target = torch.randn(50)
    found = calibration(target.clone(), target)
    assert found["slope"] == pytest.approx(1.0)
    assert found["r2"] == pytest.approx(1.0)
    assert found["bias"] == pytest.approx(0.0)


def test_what_does_not_vary_has_no_slope_or_share() -> None:
    found = calibration(torch.ones(5), torch.randn(5))
    assert found["slope"] is None
    assert found["r2"] is not None
    found = calibration(torch.randn(5), torch.ones(5))
    assert found["r2"] is None
    assert calibration(torch.zeros(0), torch.zeros(0))["bias"] is None
