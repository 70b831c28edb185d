"""Where and when something thrown will pass the plane before the robot: labels from its own eyes.

An episode is a recording: what the robot sees late in a throw tells where the ball was going all
along. Each row of a throw (`egovcp_train.labels.throw`) is labelled with the point where its path
crosses a plane before the robot, the time left until then, and where in the picture it is. No
simulator truth enters: the same labels come from a real robot's data. They train a head of the
world model (`egovcp.model.losses.passing_loss`) and say which pixels are the thing's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp import spec
from egovcp.data import EpisodeStore
from egovcp.model.threads import one_thread
from egovcp.robot.kinematics import rotate
from egovcp_train.labels.camera import Array, turn
from egovcp_train.labels.config import PassingConfig
from egovcp_train.labels.flight import in_picture
from egovcp_train.labels.throw import Throw, find_throw


def label(store: EpisodeStore, config: PassingConfig) -> EpisodeStore:
    """The same episodes with ``passing`` filled in."""
    passing = np.zeros((store.num_frames, spec.PASSING_DIM), dtype=np.float32)
    spans = zip(store.start, store.length, strict=True)
    with one_thread():
        for start, length in tqdm(
            spans, total=len(store.start), unit="ep", desc="label", leave=False
        ):
            rows = slice(start, start + length)
            passing[rows] = label_episode(store.depth[rows], store.state[rows], config)
    return replace(store, passing=passing)


def label_episode(
    depth: NDArray[np.uint16], state: NDArray[np.floating], config: PassingConfig
) -> NDArray[np.float32]:
    """The labels (T, 9) of one episode, as in `EpisodeStore.passing`.

    From the first sighting to the crossing something is on its way. Rows of an episode with
    too few sightings for a path are known to be empty; with enough of them, but no path,
    nothing is known.
    """
    out = np.zeros((len(depth), spec.PASSING_DIM), dtype=np.float32)
    out[:, 4] = 1.0
    throw = find_throw(depth, state, config)
    if len(throw.rows) < config.min_sightings:
        return out
    if throw.path is None:
        out[throw.rows[0] : throw.rows[-1] + 1, 4] = 0.0
        return out
    where, left = crossing(throw, config)
    t = np.arange(len(depth)) * spec.PLANNER_DT
    flight = (t >= throw.path.seen[0]) & (left >= 0)
    if np.abs(where[flight]).max(initial=0.0) > config.max_offset:
        out[flight, 4] = 0.0
        return out
    out[flight, :2] = where[flight]
    out[flight, 2] = left[flight]
    out[flight, 3] = 1.0
    out[:, 5:] = in_picture(throw, config)
    return out


def crossing(throw: Throw, config: PassingConfig) -> tuple[Array, Array]:
    """Where and when the path crosses the plane of each row's pelvis: (T, 2) y and z in m of its
    heading frame, z from the neutral height, and (T,) s left."""
    assert throw.path is not None
    track, path = throw.track, throw.path
    when = path.time_at(track.pelvis[:, 0] + config.plane)
    at = path.at(when)
    at[:, :2] -= track.pelvis[:, :2]
    where = rotate(turn(-track.yaw), at)[:, 1:]
    left: Array = when - throw.age - np.arange(len(when)) * spec.PLANNER_DT
    return where, left
