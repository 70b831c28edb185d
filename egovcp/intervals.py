"""Confidence intervals of rates and of other statistics of episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

type Interval = tuple[float, float]

Z95: Final = 1.959964  # two-sided 95 % quantile of the normal distribution
_RESAMPLES: Final = 4000


def wilson(successes: int, trials: int) -> Interval:
    """Wilson's score interval of a rate, at 95 %; valid also at 0 and 1.

    (p + z^2/2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)
    """
    p, n = successes / trials, trials
    middle = p + Z95**2 / (2 * n)
    half = Z95 * math.sqrt(p * (1 - p) / n + Z95**2 / (4 * n * n))
    scale = 1 + Z95**2 / n
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)


def bootstrap(
    statistic: Callable[[NDArray[np.int64]], NDArray[np.floating]], count: int
) -> Interval:
    """95 % percentile bootstrap interval of a statistic of ``count`` episodes.

    The resamples have a fixed seed. For a paired comparison the statistic reads both measurements
    at the same indices.

    Args:
        statistic: episode indices (R, count) -> the statistic of each row, (R,).
    """
    picks = np.random.default_rng(0).integers(count, size=(_RESAMPLES, count))
    low, high = np.percentile(statistic(picks), [2.5, 97.5])
    return float(low), float(high)


def points_range(interval: Sequence[float]) -> str:
    """An interval of differences of rates, percentage points, as ``-3.0 to +8.5``."""
    return f"{100 * interval[0]:+.1f} to {100 * interval[1]:+.1f}"


def signed_range(interval: Sequence[float]) -> str:
    """An interval of rewards per step as ``-0.00120 to +0.00340``."""
    return f"{interval[0]:+.5f} to {interval[1]:+.5f}"
