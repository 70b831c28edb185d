"""Colours shared by the Rerun log and the pictures."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

#: Dark blue, teal, green, yellow: even steps of lightness, read by the colour-blind too.
_STOPS: Final = np.array(
    [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], np.float64
)
LEFT: Final = (230, 97, 1)
RIGHT: Final = (94, 60, 153)
SPHERE: Final = (214, 39, 40)
OBSTACLE: Final = (150, 140, 120)


def value_colours(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """(n,) values -> (n, 3) RGB: the least dark blue, the greatest yellow."""
    v = np.nan_to_num(np.asarray(values, np.float64))
    span = float(v.max() - v.min()) if v.size else 0.0
    share = (v - v.min()) / span if span > 0 else np.ones_like(v)
    at = share * (len(_STOPS) - 1)
    low = np.minimum(at.astype(int), len(_STOPS) - 2)
    rest = (at - low)[:, None]
    mixed: NDArray[np.float64] = _STOPS[low] * (1 - rest) + _STOPS[low + 1] * rest
    return np.rint(mixed).astype(np.uint8)
