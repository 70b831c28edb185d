"""How a set of numbers is distributed, in seven numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Spread:
    """Extremes, quantiles, mean and standard deviation."""

    low: float
    q05: float
    median: float
    q95: float
    high: float
    mean: float
    std: float

    @classmethod
    def of(cls, values: NDArray[Any]) -> Self | None:
        """The spread of ``values`` of any shape; None of none."""
        flat = np.asarray(values, np.float64).reshape(-1)
        if not flat.size:
            return None
        low, q05, median, q95, high = np.quantile(flat, (0.0, 0.05, 0.5, 0.95, 1.0)).tolist()
        return cls(low, q05, median, q95, high, float(flat.mean()), float(flat.std()))
