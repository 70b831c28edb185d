"""Confidence intervals of rates."""

from __future__ import annotations

import math
from typing import Final

type Interval = tuple[float, float]

Z95: Final = 1.959964  # two-sided 95 % quantile of the normal distribution


def wilson(successes: int, trials: int) -> Interval:
    """Wilson's score interval of a rate; it stays inside [0, 1] and is honest at 0 and 1.

    (p + z^2/2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)
    """
    p, n = successes / trials, trials
    middle = p + Z95**2 / (2 * n)
    half = Z95 * math.sqrt(p * (1 - p) / n + Z95**2 / (4 * n * n))
    scale = 1 + Z95**2 / n
    return max(0.0, (middle - half) / scale), min(1.0, (middle + half) / scale)
