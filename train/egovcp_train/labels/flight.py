"""Where in the picture a thing in flight is, from the recording alone.

A recording stores no simulator truth. But it knows the end of each throw: the sightings of one
episode that lie on one ballistic path (`egovcp_train.labels.throw`) are sightings of one thrown
thing. Seen from the camera at each row of its flight, that path says where the thing is; its
pixels are those within `REACH` to each side of that place and near its depth
(`egovcp.model.depth.thing_pixels`). The flight is judged from its first sighting until the thing is
`STOP` before the pelvis: what is there and nearer may be a hand, and after a touch the path is
another.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from egovcp import spec
from egovcp_train.labels.camera import Array
from egovcp_train.labels.config import PassingConfig
from egovcp_train.labels.throw import Throw

REACH: Final = 0.16  # m; a ball is 0.1 m in radius, its path is known to about 0.05 m
STOP: Final = 0.65  # m before the pelvis, the radius beyond the hands' reach


def in_picture(throw: Throw, config: PassingConfig) -> Array:
    """(T, 4) of the thing: row and column of its middle, pixels; the radius within which its
    pixels are, pixels, 0 where it is not in flight; depth of its surface, m."""
    rows = len(throw.track.yaw)
    out = np.zeros((rows, 4))
    if throw.path is None:
        return out
    t = np.arange(rows, dtype=np.float64) * spec.PLANNER_DT
    stop = throw.path.time_at(throw.track.pelvis[:, 0] + STOP)
    flies = (t > throw.path.seen[0] - spec.PLANNER_DT / 2) & (t < stop)
    x, left, up = throw.track.to_camera(throw.path.at(t)).T
    flies &= x > config.radius + 0.05  # not behind the lens
    scale = config.focal / np.where(flies, x, 1.0)
    out[:, 0] = (spec.DEPTH_ROWS - 1) / 2 - up * scale
    out[:, 1] = (spec.DEPTH_COLS - 1) / 2 - left * scale
    out[:, 2] = REACH * scale
    out[:, 3] = x - config.radius
    return np.where(flies[:, None], out, 0.0)
