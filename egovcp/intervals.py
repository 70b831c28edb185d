"""Confidence intervals of rates, and of whatever episodes say together."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

type Interval = tuple[float, float]

Z95: Final = 1.959964  # two-sided 95 % quantile of the normal distribution
_RESAMPLES: Final = 4000


def wilson(successes: int, trials: int) -> Interval:
    """Wilson's score interval of a rate; it stays inside [0, 1] and is honest at 0 and 1.

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
    """95 % percentile interval of a statistic of ``count`` episodes.

    What was measured on the same episodes is paired by reading both with the same picks. The draws
    are fixed: equal episodes give equal intervals.

    Args:
        statistic: picks (R, count) of episodes -> the statistic of each row, (R,).
        count: number of episodes.
    """
    picks = np.random.default_rng(0).integers(count, size=(_RESAMPLES, count))
    low, high = np.percentile(statistic(picks), [2.5, 97.5])
    return float(low), float(high)
