"""Where and when something thrown will pass the plane before the robot: labels from its own eyes.

An episode is a recording: what the robot sees late in a throw tells where the ball was going all
along. Each row of a throw (`egovcp_train.labels.throw`) is labelled with the point where its path
crosses a plane before the robot, the time left until then, and where in the picture it is. No
simulator truth enters: the same labels come from a real robot's data. They train a head of the
world model (`egovcp.model.losses.passing_loss`) and say which pixels are the thing's.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp import spec
from egovcp.data import EpisodeStore
from egovcp.errors import EnvironmentFailure
from egovcp.model.threads import one_thread
from egovcp.robot.kinematics import rotate
from egovcp.workers import inherited_by_workers
from egovcp_train.labels.camera import Array, turn
from egovcp_train.labels.config import PassingConfig
from egovcp_train.labels.flight import in_picture
from egovcp_train.labels.throw import Throw, find_throw

ALONE: Final = 2000
"""Episodes up to which other processes, which need seconds to begin, gain little."""
_AT_ONCE: Final = 32  # episodes for a process
_MOST: Final = 8  # processes, each of which needs memory for torch

type _Episode = tuple[NDArray[np.uint16], NDArray[np.float32]]  # depth, state


def label(store: EpisodeStore, config: PassingConfig, workers: int = 1) -> EpisodeStore:
    """The same episodes with ``passing`` filled in.

    Args:
        store: the episodes.
        config: of the labels.
        workers: processes, at most 8, for more than `ALONE` episodes; the labels are the same.

    Raises:
        EnvironmentFailure: such a process was killed.
    """
    spans = [slice(a, a + n) for a, n in zip(store.start, store.length, strict=True)]
    passing = np.zeros((len(store.state), spec.PASSING_DIM), dtype=np.float32)
    episodes = [(store.depth[rows], store.state[rows]) for rows in spans]
    alone = workers == 1 or len(episodes) <= ALONE
    found = _labelled(episodes, config) if alone else _shared(episodes, config, workers)
    pairs = zip(spans, found, strict=True)
    for rows, labels in tqdm(pairs, total=len(spans), unit="ep", desc="label", leave=False):
        passing[rows] = labels
    return replace(store, passing=passing)


def _shared(
    episodes: list[_Episode], config: PassingConfig, workers: int
) -> Iterator[NDArray[np.float32]]:
    parts = [episodes[i : i + _AT_ONCE] for i in range(0, len(episodes), _AT_ONCE)]
    work = partial(_all_labelled, config=config)
    pool = ProcessPoolExecutor(min(workers, _MOST), multiprocessing.get_context("spawn"))
    try:
        with inherited_by_workers():
            found = pool.map(work, parts)
        for part in found:
            yield from part
    except BrokenProcessPool as error:
        raise EnvironmentFailure(
            "a process that labels episodes was killed (out of memory?); try fewer --threads"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _all_labelled(episodes: list[_Episode], config: PassingConfig) -> list[NDArray[np.float32]]:
    return list(_labelled(episodes, config))


def _labelled(episodes: list[_Episode], config: PassingConfig) -> Iterator[NDArray[np.float32]]:
    with one_thread():
        for depth, state in episodes:
            yield label_episode(depth, state, config)


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
