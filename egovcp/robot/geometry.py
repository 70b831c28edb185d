"""Rotations and the pinhole camera, in numpy, batched over leading axes.

Quaternions are wxyz. A camera frame has x along the optical axis, y left, z up; pixels are square:

    f = (rows / 2) / tan(fov / 2)        ray of pixel (i, j) = (1, -(j - c_x) / f, -(i - c_y) / f)
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from egovcp.spec import DEPTH_COLS, DEPTH_ROWS

Array = NDArray[np.float64]


def rotate(rotation: Array, vector: Array) -> Array:
    """(..., 3, 3) times (..., 3), broadcast; the same bits for a row whatever the batch."""
    out: Array = (rotation @ vector[..., None])[..., 0]
    return out


def rotation_matrix(quaternion: NDArray[np.floating]) -> Array:
    """Unit quaternions (..., 4) -> rotation matrices (..., 3, 3)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion(rotation: Array) -> Array:
    """Rotation matrices (..., 3, 3) -> unit quaternions (..., 4).

    Normalises the row of the symmetric matrix 4 q q^T whose diagonal element is largest, so no
    division is by a small number.
    """
    m = rotation
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, xy = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 1] + m[..., 1, 0]
    wy, xz = m[..., 0, 2] - m[..., 2, 0], m[..., 0, 2] + m[..., 2, 0]
    wz, yz = m[..., 1, 0] - m[..., 0, 1], m[..., 1, 2] + m[..., 2, 1]
    rows = (
        (1 + xx + yy + zz, wx, wy, wz),
        (wx, 1 + xx - yy - zz, xy, xz),
        (wy, xy, 1 - xx + yy - zz, yz),
        (wz, xz, yz, 1 - xx - yy + zz),
    )
    outer = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(outer, largest[..., None, None], axis=-2)[..., 0, :]
    out: Array = row / np.sqrt(np.sum(row * row, axis=-1, keepdims=True))
    return out


def rotation_vector(before: Array, after: Array) -> Array:
    """Rotation of less than half a turn from one attitude (..., 3, 3) to another: (..., 3) rad, in
    the first one's frame."""
    turn = np.swapaxes(before, -1, -2) @ after
    skew = 0.5 * np.stack(
        [
            turn[..., 2, 1] - turn[..., 1, 2],
            turn[..., 0, 2] - turn[..., 2, 0],
            turn[..., 1, 0] - turn[..., 0, 1],
        ],
        axis=-1,
    )
    sine = np.linalg.norm(skew, axis=-1, keepdims=True)
    cosine = 0.5 * (np.trace(turn, axis1=-2, axis2=-1)[..., None] - 1.0)
    angle = np.arctan2(sine, cosine)
    return np.asarray(skew * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0))


def heading_rotation(gravity: Array) -> Array:
    """Rotation (B, 3, 3) from the pelvis frame to the pelvis heading frame.

    ``gravity`` (B, 3) is the unit gravity vector in the pelvis frame. The heading frame's z is
    -gravity, its x the pelvis' x made horizontal. A pelvis that points straight up or down
    has no heading; the result is then finite but not a rotation.
    """
    up = -gravity / np.maximum(np.sqrt((gravity**2).sum(axis=-1, keepdims=True)), 1e-9)
    ux, uy, uz = up[:, 0], up[:, 1], up[:, 2]
    norm = np.maximum(np.sqrt(uy * uy + uz * uz), 1e-6)
    out = np.empty((len(up), 3, 3))  # nested np.stack is slower for few robots
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = norm, -ux * uy / norm, -ux * uz / norm
    out[:, 1, 0], out[:, 1, 1], out[:, 1, 2] = 0.0, uz / norm, -uy / norm
    out[:, 2] = up
    return out


def focal_length(vertical_fov: float, rows: int = DEPTH_ROWS) -> float:
    """Pixels, of a depth image with this vertical field of view (rad)."""
    return rows / 2 / math.tan(vertical_fov / 2)


def pixel_rays(focal: float, rows: int = DEPTH_ROWS, columns: int = DEPTH_COLS) -> Array:
    """Directions (H * W, 3) of all pixels of a depth image, camera frame, with x = 1."""
    row, column = np.mgrid[:rows, :columns]
    left = -(column - (columns - 1) / 2) / focal
    up = -(row - (rows - 1) / 2) / focal
    return np.stack([np.ones(left.shape), left, up], axis=-1).reshape(-1, 3)
