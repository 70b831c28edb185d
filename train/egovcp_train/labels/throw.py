"""The path of what is thrown at the robot, from its pictures and proprioception.

Sightings (pixels that came nearer, `egovcp.model.depth.approaching`) of one episode are projected
into a frame that stays put; those of one throw are fitted by a ballistic path

    x(t) = p + v t + g t^2 / 2
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp import spec
from egovcp.model.depth import MIN_PIXELS, approaching, nearness
from egovcp_train.labels.camera import Array, CameraTrack, camera_track
from egovcp_train.labels.config import PassingConfig

GRAVITY: Final = np.array([0.0, 0.0, -9.81])  #: m/s^2
_LOOKS: Final = 3  # a path that leads half way at first leads all the way at last
_SEARCH: Final = 0.35  # m, around the place where a thing may be
_HANDS: Final = 0.9  # m before the camera, where hands begin


class Path(NamedTuple):
    """A ballistic path, and the times (n,) s of the sightings that support it."""

    position: Array  # (3,) m at t = 0
    velocity: Array  # (3,) m/s at t = 0
    seen: Array
    error: float = 0.0  # mean distance of those sightings from the path, in tolerances

    def at(self, t: Array | float) -> Array:
        """(...,) s -> (..., 3) m."""
        s = np.asarray(t, dtype=np.float64)[..., None]
        return self.position + self.velocity * s + 0.5 * GRAVITY * s * s

    def time_at(self, x: Array | float) -> Array:
        """When it is at ``x`` (...,) m, (...,) s."""
        return np.asarray((x - self.position[0]) / self.velocity[0], dtype=np.float64)


@dataclass(frozen=True)
class Throw:
    """What one episode shows of a throw."""

    rows: NDArray[np.intp]
    """(n,) rows in which something approaches."""
    track: CameraTrack
    """The camera's way."""
    age: float
    """How old a picture is, s."""
    path: Path | None
    """The path of what is thrown, at the times of the rows in whose pictures it is seen: ``age``
    after the truth; None: no throw, or it cannot be told."""


def find_throw(
    depth: NDArray[np.uint16], state: NDArray[np.floating], config: PassingConfig
) -> Throw:
    """The throw of one episode, (T, 48, 64) mm and (T, 74).

    A picture is older than the state beside it, by a time that is drawn for each episode: the
    age under which most sightings lie on one path, and then most closely, is taken.
    """
    near = nearness(torch.from_numpy(depth.astype(np.int32)), spec.DEPTH_MAX_M)
    point, seen = sightings(near, config)
    rows = np.flatnonzero(seen)
    t = rows.astype(np.float64) * spec.PLANNER_DT
    throws: list[Throw] = []
    at_rows = camera_track(state, config)
    for age in config.picture_ages:
        track = at_rows.aged(age)
        path = fit_path(t, track.to_ground(point)[rows], config)
        throws.append(Throw(rows, track, age * spec.PLANNER_DT, path))
    found = max(throws, key=_support)
    for _ in range(_LOOKS):
        found = _look_again(found, near, config)
    return found


def _look_again(throw: Throw, near: Tensor, config: PassingConfig) -> Throw:
    """The same throw, its path fitted to what is seen around it in every picture of its flight.

    Sightings at first glance are few: a thing that flies straight at the camera hardly moves
    in the picture. Once its path is roughly known, it is known where to look.
    """
    if throw.path is None:
        return throw
    rows, point = sightings_along(throw, near, config)
    path = fit_path(rows.astype(np.float64) * spec.PLANNER_DT, point, config)
    better = path is not None and len(path.seen) >= len(throw.path.seen)
    return replace(throw, path=path) if better else throw


def sightings_along(
    throw: Throw, near: Tensor, config: PassingConfig
) -> tuple[NDArray[np.intp], Array]:
    """Where a thing is seen around its path: (n,) rows, and (n, 3) m in the frame that stays put.

    Args:
        throw: with a path.
        near: (T, 48, 64) nearness of all pictures.
        config: how throws are found.
    """
    assert throw.path is not None
    t = np.arange(len(near), dtype=np.float64) * spec.PLANNER_DT
    expected = throw.track.to_camera(throw.path.at(t))
    flies = (t > throw.path.seen[0] - 0.1) & (expected[:, 0] > _HANDS)
    rows = np.flatnonzero(flies & (t < throw.path.time_at(config.plane)))
    point = np.zeros((len(near), 3))
    point[rows], seen = _around(near[rows], expected[rows], config)
    rows = rows[seen]
    return rows, throw.track.to_ground(point)[rows]


def _around(
    near: Tensor, expected: Array, config: PassingConfig
) -> tuple[Array, NDArray[np.bool_]]:
    """(n, 48, 64) nearness and where a thing may be, (n, 3) m, camera frame -> where it is,
    (n, 3) m; (n,) whether it is seen."""
    x, left, up = (torch.from_numpy(expected[:, i, None, None]).float() for i in range(3))
    z = (1 - near) * spec.DEPTH_MAX_M + config.radius
    row = (torch.arange(spec.DEPTH_ROWS)[:, None] - (spec.DEPTH_ROWS - 1) / 2) / config.focal
    col = (torch.arange(spec.DEPTH_COLS) - (spec.DEPTH_COLS - 1) / 2) / config.focal
    away = torch.hypot(col * x + left, row * x + up)
    weight = ((near > 0) & ((z - x).abs() < _SEARCH) & (away < _SEARCH)).float()
    n = weight.sum((1, 2))
    mean = [(weight * v).sum((1, 2)) / n.clamp_min(1) for v in (z, -z * col, -z * row)]
    cut = weight[:, [0, -1]].sum((1, 2)) + weight[:, :, [0, -1]].sum((1, 2))  # its middle is lost
    return torch.stack(mean, -1).double().numpy(), ((n >= MIN_PIXELS) & (cut == 0)).numpy()


def _support(throw: Throw) -> tuple[int, float]:
    return (0, 0.0) if throw.path is None else (len(throw.path.seen), -throw.path.error)


def sightings(near: Tensor, config: PassingConfig) -> tuple[Array, NDArray[np.bool_]]:
    """(T, 48, 64) nearness -> where something approaches, camera frame, (T, 3) m; (T,) seen."""
    centre, seen = approaching(near[None])
    centre, seen = centre[0], seen[0]
    focal = config.focal
    rows = torch.linspace(-1, 1, spec.DEPTH_ROWS)[None, :, None]
    cols = torch.linspace(-1, 1, spec.DEPTH_COLS)[None, None]
    t = torch.nonzero(seen)[:, 0]
    at = centre[t]
    reach = 0.3 * focal / ((1 - at[:, 2]) * spec.DEPTH_MAX_M)  # pixels that 0.3 m cover there
    mask = (near[t] - at[:, 2, None, None]).abs() < 0.08
    mask &= (cols - at[:, 0, None, None]).abs() * (spec.DEPTH_COLS / 2) < reach[:, None, None]
    mask &= (rows - at[:, 1, None, None]).abs() * (spec.DEPTH_ROWS / 2) < reach[:, None, None]
    weight = mask.float()
    n = weight.sum((1, 2)).clamp_min(1)
    u = (weight * cols).sum((1, 2)) / n
    v = (weight * rows).sum((1, 2)) / n
    z = (1 - (weight * near[t]).sum((1, 2)) / n) * spec.DEPTH_MAX_M + config.radius
    out = np.zeros((len(near), 3))
    right = u * ((spec.DEPTH_COLS - 1) / 2) / focal
    down = v * ((spec.DEPTH_ROWS - 1) / 2) / focal
    out[t.numpy()] = torch.stack([z, -z * right, -z * down], -1).numpy()
    return out, seen.numpy()


def fit_path(t: Array, point: Array, config: PassingConfig) -> Path | None:
    """The path of sightings (n, 3) at times (n,), or None.

    Every pair of sightings proposes a path; the one that most sightings agree with is refined
    by least squares. A flicker at the edge of the floor is outvoted.
    """
    if len(t) < config.min_sightings:
        return None
    straight = point - 0.5 * GRAVITY * (t * t)[:, None]  # p + v t
    i, j = np.triu_indices(len(t), 1)
    v = (straight[j] - straight[i]) / (t[j] - t[i])[:, None]
    p = straight[i] - v * t[i, None]
    tolerance = config.tolerance * np.maximum(point[:, 0], 1.0)
    error = np.linalg.norm(p[:, None] + v[:, None] * t[:, None] - straight, axis=-1)
    agree = error < tolerance
    votes = agree.sum(1) * ((v[:, 0] < -config.min_speed) & (v[:, 0] > -config.max_speed))
    best = int(np.argmax(votes))
    if votes[best] < config.min_sightings:
        return None
    keep = agree[best]
    weight = (1.0 / tolerance[keep])[:, None]
    design = np.stack([np.ones(int(keep.sum())), t[keep]], -1)
    p, v = np.linalg.lstsq(weight * design, weight * straight[keep], rcond=None)[0]
    left = np.linalg.norm(weight * (p + v * t[keep, None] - straight[keep]), axis=-1).mean()
    return Path(p, v, t[keep], float(left))
