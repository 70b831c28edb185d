"""Headings of many robots."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def heading(turn: Array) -> Array:
    """(N, 3, 3) rotations -> (N, 2) unit vector of the horizontal forward direction."""
    forward = turn[:, :2, 0]
    return np.asarray(forward / np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-6))


def in_heading(vector: Array, forward: Array) -> Array:
    """World vectors (N, ..., 2 or 3) -> their x and y in the heading frame (N, ..., 2)."""
    shape = (len(forward), *(1,) * (vector.ndim - 2))
    c, s = forward[:, 0].reshape(shape), forward[:, 1].reshape(shape)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([c * x + s * y, c * y - s * x], axis=-1)
