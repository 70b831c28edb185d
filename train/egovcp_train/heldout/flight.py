"""Which pixels are those of a thing in flight, from the recording alone.

A recording stores no simulator truth. But it knows the end of each throw: the sightings of one
episode that lie on one ballistic path (`egovcp_train.passing`) are sightings of one thrown thing.
Its pixels, in a row of such a sighting, are those within `REACH` to each side of the middle of
what came nearer and within 0.4 m of its depth. A row in which the thing is not sighted (out of
the picture, hidden, lost in noise), or after it has passed or hit something, has no such pixels.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp import spec
from egovcp.model.depth import nearness
from egovcp_train.passing import PassingConfig, find_path, sighted_pixels

REACH: Final = 0.13  # m; a ball is 0.1 m in radius, and half a pixel at 3 m is 0.03 m


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
    if path is None:
        return out
    crossing = path.time_at(config.plane)
    if np.abs(path.at(crossing)[1:]).max() > config.max_offset:
        return out
    near = nearness(torch.from_numpy(depth.astype(np.int32)), spec.DEPTH_MAX_M)
    rows, pixels = sighted_pixels(near, config, REACH)
    flying = np.rint(path.seen[path.seen <= crossing] / spec.PLANNER_DT).astype(np.intp)
    of_flight = np.isin(rows.numpy(), flying)
    out[rows.numpy()[of_flight]] = pixels.numpy()[of_flight]
    return out
