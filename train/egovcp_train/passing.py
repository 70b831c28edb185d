"""Where and when something thrown will pass the plane before the robot: labels from its own eyes.

An episode is a recording: what the robot sees late in a throw tells where the ball was going
all along. Sightings (pixels that came nearer, `egovcp.model.depth.approaching`) are projected
into the heading frame at the pelvis; those of one throw are fitted by a ballistic path

    x(t) = p + v t + g t^2 / 2

and each row of the throw is labelled with the point where that path crosses a plane before the
robot, and the time left until then. No simulator truth enters: the same labels come from a real
robot's data. They train a head of the world model (`egovcp.model.losses.passing_loss`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp import spec
from egovcp.data import EpisodeStore
from egovcp.model.depth import approaching, nearness
from egovcp.robot.kinematics import LINK_NAMES, heading_rotation, link_transforms, rotate

Array = NDArray[np.float64]

_GRAVITY: Final = np.array([0.0, 0.0, -9.81])  # m/s^2
_TORSO: Final = LINK_NAMES.index("torso_link")
_FEET: Final = [LINK_NAMES.index(f"{side}_ankle_roll_link") for side in ("left", "right")]
_STANDING: Final = 0.70  # m, about the height of the pelvis above the ankles in the neutral pose


@dataclass(frozen=True)
class PassingConfig:
    """Geometry of the camera, and what counts as a throw."""

    plane: float = 0.32
    """The plane, before the pelvis, m."""
    camera_position: tuple[float, float, float] = (0.058, 0.0, 0.42)
    """Mount in the torso frame, m (the simulator's default)."""
    camera_pitch: float = math.radians(-2.5)
    """Tilt below the torso's horizontal, rad (the middle of the simulator's range)."""
    vertical_fov: float = math.radians(58.0)
    """Vertical field of view, rad."""
    radius: float = 0.10
    """What is added to the depth of a surface to reach the middle of the thing, m."""
    min_sightings: int = 4
    """A path needs this many sightings."""
    tolerance: float = 0.05
    """Distance of a sighting from its path, per metre of its own distance, m."""
    min_speed: float = 1.5
    """What comes more slowly is not thrown, m/s."""
    max_speed: float = 8.0
    """What comes faster is a mistake, m/s."""
    max_offset: float = 1.0
    """A path that passes farther to the side or in height is a mistake, m."""

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return spec.DEPTH_ROWS / 2 / math.tan(self.vertical_fov / 2)


class Path(NamedTuple):
    """A ballistic path, and the times (n,) s of the sightings that support it."""

    position: Array  # (3,) m at t = 0
    velocity: Array  # (3,) m/s at t = 0
    seen: Array

    def time_at(self, plane: float) -> float:
        """When x = ``plane``, s."""
        return float((plane - self.position[0]) / self.velocity[0])

    def at(self, t: float) -> Array:
        """(3,) m."""
        return self.position + self.velocity * t + 0.5 * _GRAVITY * t * t


def sightings(depth: NDArray[np.uint16], config: PassingConfig) -> tuple[Array, NDArray[np.bool_]]:
    """(T, 48, 64) mm -> where something approaches, in the camera frame, (T, 3) m; (T,) seen."""
    near = nearness(torch.from_numpy(depth.astype(np.int32)), spec.DEPTH_MAX_M)
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
    out = np.zeros((len(depth), 3))
    right = u * ((spec.DEPTH_COLS - 1) / 2) / focal
    down = v * ((spec.DEPTH_ROWS - 1) / 2) / focal
    out[t.numpy()] = torch.stack([z, -z * right, -z * down], -1).numpy()
    return out, seen.numpy()


def to_ground(point: Array, state: NDArray[np.floating], config: PassingConfig) -> Array:
    """(T, 3) camera frame -> a frame that does not move with the robot.

    Its axes are those of the heading frame in the first row, its origin the pelvis at
    neutral height. A picture is older than the state that comes with it, by about one row.
    """
    s = np.asarray(state, dtype=np.float64)
    s = np.concatenate([s[:1], s[:-1]])
    position, rotation = link_transforms(s[:, spec.STATE_SLICES["joint_position"]])
    c, d = np.cos(config.camera_pitch), np.sin(config.camera_pitch)
    tilt = np.array([[c, 0.0, d], [0.0, 1.0, 0.0], [-d, 0.0, c]])
    in_torso = np.array(config.camera_position) + point @ tilt.T
    in_pelvis = position[:, _TORSO] + rotate(rotation[:, _TORSO], in_torso)
    heading = heading_rotation(s[:, spec.STATE_SLICES["projected_gravity"]])
    out = rotate(turn(yaw(s)), rotate(heading, in_pelvis))
    feet = rotate(heading[:, None], position[:, _FEET])[..., 2]
    out[:, 2] -= feet.mean(1) + _STANDING
    return out


def yaw(state: NDArray[np.floating]) -> Array:
    """(T,) rad, turn of the heading since the first row, integrated from the gyroscope."""
    s = np.asarray(state, dtype=np.float64)
    up = heading_rotation(s[:, spec.STATE_SLICES["projected_gravity"]])[:, 2]
    rate = (up * s[:, spec.STATE_SLICES["angular_velocity"]]).sum(-1)
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]))]) * spec.PLANNER_DT


def turn(angle: Array) -> Array:
    """(T,) rad -> (T, 3, 3) rotations about the vertical."""
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    rows = ((c, -s, zero), (s, c, zero), (zero, zero, one))
    return np.stack([np.stack(row, -1) for row in rows], -2)


def fit_path(t: Array, point: Array, config: PassingConfig) -> Path | None:
    """The path of sightings (n, 3) at times (n,), or None.

    Every pair of sightings proposes a path; the one that most sightings agree with is refined
    by least squares. A flicker at the edge of the floor is outvoted.
    """
    if len(t) < config.min_sightings:
        return None
    straight = point - 0.5 * _GRAVITY * (t * t)[:, None]  # p + v t
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
    return Path(p, v, t[keep])


def find_path(
    depth: NDArray[np.uint16], state: NDArray[np.floating], config: PassingConfig
) -> tuple[NDArray[np.intp], Path | None]:
    """The rows of one episode in which something approaches, and the path of what is thrown."""
    point, seen = sightings(depth, config)
    rows = np.flatnonzero(seen)
    if len(rows) < config.min_sightings:
        return rows, None
    ground = to_ground(point, state, config)
    return rows, fit_path(rows.astype(np.float64) * spec.PLANNER_DT, ground[rows], config)


def label(store: EpisodeStore, config: PassingConfig) -> EpisodeStore:
    """The same episodes with ``passing`` filled in."""
    passing = np.zeros((store.num_frames, spec.PASSING_DIM), dtype=np.float32)
    episodes = zip(store.start, store.length, strict=True)
    for start, length in tqdm(
        episodes, total=len(store.start), unit="ep", desc="label", leave=False
    ):
        rows = slice(start, start + length)
        passing[rows] = label_episode(store.depth[rows], store.state[rows], config)
    return replace(store, passing=passing)


def label_episode(
    depth: NDArray[np.uint16], state: NDArray[np.floating], config: PassingConfig
) -> NDArray[np.float32]:
    """The labels (T, 5) of one episode, as in `EpisodeStore.passing`.

    From the first sighting to the crossing something is on its way. Rows of an episode with
    too few sightings for a path are known to be empty; with enough of them, but no path,
    nothing is known.
    """
    out = np.zeros((len(depth), spec.PASSING_DIM), dtype=np.float32)
    out[:, 4] = 1.0
    rows, path = find_path(depth, state, config)
    if len(rows) < config.min_sightings:
        return out
    if path is None:
        out[rows[0] : rows[-1] + 1, 4] = 0.0
        return out
    crossing = path.time_at(config.plane)
    where = path.at(crossing)
    t = np.arange(len(depth)) * spec.PLANNER_DT
    flight = (t >= path.seen[0]) & (t <= crossing)
    if np.abs(where[1:]).max() > config.max_offset:
        out[flight, 4] = 0.0
        return out
    out[flight, :2] = rotate(turn(-yaw(state)), where)[flight, 1:]
    out[flight, 2] = crossing - t[flight]
    out[flight, 3] = 1.0
    return out
