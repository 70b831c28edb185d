"""Which pixels are those of a thing in flight, from the recording alone.

A recording stores no simulator truth. But it knows the end of each throw: the sightings of one
episode that lie on one ballistic path (`egovcp_train.passing`) are sightings of one thrown thing.
Seen from the camera at each row of its flight, that path says where the thing is; its pixels are
those within `REACH` to each side of that place and `SLACK` of its depth. The flight is judged
from its first sighting until the thing is `STOP` before the pelvis: what is there and nearer may
be a hand, and after a touch the path is another.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp import spec
from egovcp.model.depth import nearness
from egovcp_train.passing import Array, PassingConfig, Path, find_path, to_ground

REACH: Final = 0.16  # m; a ball is 0.1 m in radius, its path is known to about 0.05 m
SLACK: Final = 0.20  # m
STOP: Final = 0.65  # m before the pelvis, the radius beyond the hands' reach


def flight_pixels(
    depth: NDArray[np.uint16], state: NDArray[np.floating], config: PassingConfig
) -> NDArray[np.bool_]:
    """The pixels of what is thrown at the robot in one episode.

    Args:
        depth: (T, 48, 64) mm.
        state: (T, 74).

    Returns:
        (T, 48, 64); false everywhere if nothing is thrown, or its path cannot be told.
    """
    out = np.zeros(depth.shape, dtype=np.bool_)
    _, path = find_path(depth, state, config)
    if path is None or np.abs(path.at(path.time_at(config.plane))[1:]).max() > config.max_offset:
        return out
    t = np.arange(len(depth)) * spec.PLANNER_DT
    rows = np.flatnonzero((t > path.seen[0] - spec.PLANNER_DT / 2) & (t < path.time_at(STOP)))
    place = to_camera(path, state, config)[rows]
    out[rows] = _around(depth[rows], place, config)
    return out


def to_camera(path: Path, state: NDArray[np.floating], config: PassingConfig) -> Array:
    """(T, 3) m, where on its path a thing is at each row, in the camera frame: the inverse of
    `to_ground`, which moves and turns a row's points without bending space."""
    rows = len(state)
    origin = to_ground(np.zeros((rows, 3)), state, config)
    axes = [to_ground(np.tile(axis, (rows, 1)), state, config) - origin for axis in np.eye(3)]
    where = np.stack([path.at(t) for t in np.arange(rows) * spec.PLANNER_DT])
    place: Array = np.einsum("ati,ti->ta", np.stack(axes), where - origin)
    return place


def _around(depth: NDArray[np.uint16], place: Array, config: PassingConfig) -> NDArray[np.bool_]:
    """(n, 48, 64) mm and (n, 3) m, camera frame -> the pixels of a thing at that place."""
    near = nearness(torch.from_numpy(depth.astype(np.int32)), spec.DEPTH_MAX_M).numpy()
    x, left, up = (place[:, i, None, None] for i in range(3))
    x = np.maximum(x, config.radius + 0.05)  # behind the lens: matches no pixel
    column = np.arange(spec.DEPTH_COLS) - (spec.DEPTH_COLS - 1) / 2
    row = np.arange(spec.DEPTH_ROWS)[:, None] - (spec.DEPTH_ROWS - 1) / 2
    away = np.hypot(column * x / config.focal + left, row * x / config.focal + up)  # m
    surface = x - config.radius
    found = np.abs((1 - near) * spec.DEPTH_MAX_M - surface) < SLACK
    pixels: NDArray[np.bool_] = (near > 0) & found & (away < REACH)
    return pixels
