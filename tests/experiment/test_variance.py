"""The analysis finds variances and correlations that were put in."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp_experiment.variance import Residuals, analysis, bounds


def plans(rho: float, noise: float, bias: float = 0.0, count: int = 4000) -> list[Residuals]:
    """Errors of deviation 0.5 whose steps correlate by rho; returns of 4 walks with that noise."""
    rng = np.random.default_rng(0)
    steps, walks = 4, 4
    common = rng.normal(size=(count, 1)) * rho**0.5
    errors = 0.5 * (common + rng.normal(size=(count, steps)) * (1 - rho) ** 0.5) + bias
    truth = rng.normal(size=(count, steps))
    returns = truth[:, :, None] + noise * rng.normal(size=(count, steps, walks))
    return [Residuals(truth[p] + errors[p], returns[p], returns[p] - 0.25) for p in range(count)]


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_noise_of_the_returns_is_taken_off(rho: float) -> None:
    found = analysis(plans(rho, noise=2.0, bias=0.1))
    np.testing.assert_allclose(found["sigma"], 0.5, atol=0.06)
    assert found["rho_next"] == pytest.approx(rho, abs=0.12)
    np.testing.assert_allclose(found["bias"], 0.1, atol=0.06)
    np.testing.assert_allclose(found["bias_of_cutting"], 0.25)


@pytest.mark.parametrize("rho", [0.0, 0.3, 1.0])
def test_the_variance_of_a_mean_lies_between_its_bounds(rho: float) -> None:
    for at in analysis(plans(rho, noise=0.0))["horizons"]:
        n = at["n"]
        assert at["variance"] == pytest.approx(0.25 * (1 + (n - 1) * rho) / n, rel=0.1)
        assert at["v_lb"] <= at["variance"] * 1.001
        assert at["variance"] <= at["v_ub"] * 1.001
        assert at["error"] == pytest.approx(at["variance"] + at["bias"] ** 2)


def test_the_bounds_are_those_of_the_paper() -> None:
    assert bounds(1, 0.3, 0.5, 0.9) == pytest.approx((0.09, 0.25))
    assert bounds(4, 0.5, 0.5, 0.0) == pytest.approx((0.0625, 0.0625))
    low, high = bounds(4, 0.5, 0.5, 0.5)
    assert (low, high) == (0.0, pytest.approx((4 + 0.5 * 12) / 16 * 0.25))


def test_two_plans_say_nothing() -> None:
    assert analysis(plans(0.0, 1.0, count=2)) == {"plans": 2}
