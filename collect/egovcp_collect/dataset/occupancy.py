"""How much of the action box the actions of a dataset fill, and how evenly.

Uniformity of a histogram p over n bins is its overlap with the even one, sum of min(p_i, 1 / n): 1
is even, 1 / n is a single bin. Random walks that are reflected at the walls of the box come near
1; walks that are clipped pile up on them, and a policy that always does the same is near 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from egovcp.spec import ACTION_BOX, ACTION_NAMES

BINS: Final = 40  # per action, over [-1, 1]
CELLS: Final = 8  # per axis of the grid over the x, y and z of one hand
HANDS: Final = {"left": slice(0, 3), "right": slice(3, 6)}


@dataclass(frozen=True)
class Occupancy:
    """What the N actions of a task fill."""

    histogram: dict[str, list[int]]
    """Action name -> rows in each of ``BINS`` equal bins over [-1, 1]."""
    uniformity: dict[str, float]
    """Action name -> evenness of its histogram, 0 to 1."""
    occupied: dict[str, float]
    """Hand -> share of the CELLS^3 cells of its part of the box that hold an action."""
    workspace_m: dict[str, tuple[float, float]]
    """Action name -> lowest and highest target, m, pelvis heading frame (height: above
    ground)."""

    @classmethod
    def of(cls, action: NDArray[np.floating]) -> Self:
        """The occupancy of actions (N, 7) in box units."""
        counts = {
            name: np.histogram(action[:, i], BINS, (-1.0, 1.0))[0]
            for i, name in enumerate(ACTION_NAMES)
        }
        metric = ACTION_BOX.to_metric(action)
        low, high = metric.min(axis=0), metric.max(axis=0)
        return cls(
            histogram={name: count.tolist() for name, count in counts.items()},
            uniformity={name: uniformity(count) for name, count in counts.items()},
            occupied={hand: occupied(action[:, axes]) for hand, axes in HANDS.items()},
            workspace_m={n: (float(low[i]), float(high[i])) for i, n in enumerate(ACTION_NAMES)},
        )


def uniformity(counts: NDArray[np.integer]) -> float:
    """Overlap of a histogram with the even one."""
    return float(np.minimum(counts / counts.sum(), 1.0 / len(counts)).sum())


def occupied(points: NDArray[np.floating]) -> float:
    """Share of the cells of a grid over [-1, 1]^3 that hold at least one of (N, 3) points."""
    cells = np.clip(((points + 1.0) * (CELLS / 2)).astype(np.int64), 0, CELLS - 1)
    keys = (cells[:, 0] * CELLS + cells[:, 1]) * CELLS + cells[:, 2]
    return len(np.unique(keys)) / CELLS**3
