"""Section III-D with measured residuals in the place of assumptions.

E[(J_N - J^_N)^2] = 1/N^2 sum_ij Cov[e_i, e_j] + bias^2
V_ub = (N + rho (N^2 - N)) / N^2 sigma_max^2
V_lb = max((N sigma_min^2 - rho (N^2 - N) sigma_max^2) / N^2, 0)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

type Array = NDArray[np.float64]


class Residuals(NamedTuple):
    """One plan of K steps."""

    value: Array
    """(K,) Q^ along the plan."""
    short: Array
    """(K, R) returns of random walks from each step on, cut off as those of the training data."""
    whole: Array
    """(K, R) the same to the end of the episode."""


def analysis(plans: Sequence[Residuals]) -> dict[str, Any]:
    """Variances, correlations, bounds and biases of some plans; at least three."""
    if len(plans) < 3:
        return {"plans": len(plans)}
    errors = np.stack([p.value - p.short.mean(1) for p in plans])  # (P, K)
    noise = np.stack([p.short.var(1, ddof=1) / p.short.shape[1] for p in plans]).mean(0)
    covariance = np.cov(errors.T, ddof=1)
    covariance[np.diag_indices_from(covariance)] -= noise
    covariance = _possible(covariance)
    sigma = np.sqrt(np.diag(covariance))
    rho = _correlation(covariance)
    cut = np.stack([(p.short - p.whole).mean(1) for p in plans])
    return {
        "plans": len(plans),
        "sigma": sigma.tolist(),
        "rho": rho.tolist(),
        "rho_max": _largest(rho),
        "rho_next": float(np.mean(np.diag(rho, 1))) if len(rho) > 1 else None,
        "return_noise_variance": noise.tolist(),
        "bias": errors.mean(0).tolist(),
        "bias_of_cutting": cut.mean(0).tolist(),
        "horizons": [_horizon(n, covariance, errors) for n in range(1, len(covariance) + 1)],
    }


def _possible(covariance: Array) -> Array:
    """The nearest matrix that is one: taking noise off may leave variances below zero."""
    values, vectors = np.linalg.eigh(covariance)
    fixed: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return fixed


def _correlation(covariance: Array) -> Array:
    sigma = np.sqrt(np.diag(covariance))
    scale = np.outer(sigma, sigma)
    rho: Array = np.divide(covariance, scale, out=np.eye(len(sigma)), where=scale > 0)
    return rho


def _largest(rho: Array) -> float:
    """The largest correlation between two different steps, whatever its sign."""
    apart = np.abs(rho[~np.eye(len(rho), dtype=bool)])
    return float(apart.max()) if len(apart) else 0.0


def _horizon(n: int, covariance: Array, errors: Array) -> dict[str, float]:
    """What the analysis says of J_N."""
    part = covariance[:n, :n]
    sigma = np.sqrt(np.diag(part))
    rho = _largest(_correlation(part))
    low, high = bounds(n, float(sigma.min()), float(sigma.max()), rho)
    variance = float(part.sum()) / n**2
    bias = float(errors[:, :n].mean())
    return {
        "n": n,
        "variance": variance,
        "v_lb": low,
        "v_ub": high,
        "bias": bias,
        "error": variance + bias**2,
    }


def bounds(n: int, sigma_min: float, sigma_max: float, rho: float) -> tuple[float, float]:
    """V_lb and V_ub of the paper."""
    pairs = n * n - n
    low = (n * sigma_min**2 - rho * pairs * sigma_max**2) / n**2
    return max(low, 0.0), (n + rho * pairs) / n**2 * sigma_max**2
