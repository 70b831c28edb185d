"""Depth pictures by ray casting: planar depth and the faults of a stereo camera.

A pixel (row i, column j) looks along d = (1, -(j - cx)/f, -(i - cy)/f) in the camera frame
(x along the optical axis, y left, z up), f = (rows / 2) / tan(fov / 2). The depth of a hit
at range s along d/|d| is its coordinate along the optical axis, z = s / |d|.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.sim.config import CameraConfig
from egovcp.sim.rays import Pinhole, cast
from egovcp.spec import DEPTH_COLS, DEPTH_MAX_M, DEPTH_MIN_M, DEPTH_ROWS

Array = NDArray[np.float64]


class DepthCamera:
    """Casts one ray per pixel from a mount on the torso, which itself stays unseen."""

    def __init__(self, config: CameraConfig) -> None:
        self.position = np.array(config.position)
        self.focal = DEPTH_ROWS / 2 / math.tan(config.vertical_fov / 2)  # pixels
        rays = pixel_rays(self.focal)
        self._axial = 1.0 / np.linalg.norm(rays, axis=1)  # cosine to the optical axis
        self._directions = rays * self._axial[:, None]
        self._cutoff = DEPTH_MAX_M / float(self._axial.min())
        self._pinhole = Pinhole(DEPTH_ROWS, DEPTH_COLS, self.focal)

    def pose(
        self, data: mujoco.MjData, torso_body: int, pitch: float
    ) -> tuple[Array, NDArray[np.float64]]:
        """Position (3,) and rotation (3, 3) of the camera in the world; x is the optical axis."""
        torso = data.xmat[torso_body].reshape(3, 3)
        c, s = math.cos(pitch), math.sin(pitch)
        tilt = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return data.xpos[torso_body] + torso @ self.position, torso @ tilt

    def render(
        self, model: mujoco.MjModel, data: mujoco.MjData, torso_body: int, pitch: float
    ) -> NDArray[np.float32]:
        """True planar depth (H, W), m; 0 where nothing is within the camera's range.

        ``data`` must hold current body poses (``mj_kinematics``).
        """
        origin, rotation = self.pose(data, torso_body, pitch)
        rays = self._directions @ rotation.T
        ranges = cast(model, data, self._pinhole, origin, rotation, rays, torso_body, self._cutoff)
        depth = (ranges * self._axial).astype(np.float32)
        return within_range(depth).reshape(DEPTH_ROWS, DEPTH_COLS)


def pixel_rays(focal: float) -> Array:
    """Directions (H * W, 3) of all pixels with unit length along the optical axis."""
    row, column = np.mgrid[:DEPTH_ROWS, :DEPTH_COLS]
    left = -(column - (DEPTH_COLS - 1) / 2) / focal
    up = -(row - (DEPTH_ROWS - 1) / 2) / focal
    return np.stack([np.ones(left.shape), left, up], axis=-1).reshape(-1, 3)


def within_range(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """``depth`` in metres with 0 wherever the camera would measure nothing."""
    valid = (depth >= DEPTH_MIN_M) & (depth <= DEPTH_MAX_M)
    return np.where(valid, depth, np.float32(0))


class DepthNoise:
    """The faults of one camera in one episode: noise growing with z^2, holes, lost edges."""

    def __init__(self, config: CameraConfig, rng: np.random.Generator) -> None:
        self._rng = rng
        self._per_z2 = np.float32(rng.uniform(*config.noise_per_z2))
        self._holes = np.float32(rng.uniform(*config.hole_probability))
        self._edges = np.float32(rng.uniform(*config.edge_probability))
        self._edge_ratio = np.float32(config.edge_ratio)

    def apply(self, depth: NDArray[np.float32]) -> NDArray[np.uint16]:
        """True depth (H, W) in metres -> measured depth (H, W) in millimetres, 0 invalid."""
        noise = self._rng.standard_normal(depth.shape, dtype=np.float32)
        chance = self._rng.random(depth.shape, dtype=np.float32)
        edge = discontinuity(depth, self._edge_ratio)
        lost = chance < np.where(edge, self._edges + self._holes, self._holes)
        noise *= self._per_z2 * depth * depth
        noise += depth
        return quantise(np.where(lost, np.float32(0), noise))


def quantise(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Metres -> whole millimetres, 0 for what the camera cannot measure."""
    millimetres = within_range(depth)
    millimetres *= 1000.0
    return np.rint(millimetres, out=millimetres).astype(np.uint16)


def discontinuity(depth: NDArray[np.float32], ratio: np.float32) -> NDArray[np.bool_]:
    """(H, W) pixels beside a jump of more than ``ratio`` of the greater depth.

    The floor, seen at a slant, is no discontinuity; the border of nothing (0) is.
    """
    width = depth.shape[1]
    flat = np.ascontiguousarray(depth).reshape(-1)  # long rows are quicker than many
    across = _jumps(flat[:-1], flat[1:], ratio)
    across[width - 1 :: width] = False  # the next pixel is on the other side of the picture
    down = _jumps(flat[:-width], flat[width:], ratio)
    edge = np.zeros(flat.shape, dtype=np.bool_)
    for jump, step in ((across, 1), (down, width)):
        edge[:-step] |= jump
        edge[step:] |= jump
    return edge.reshape(depth.shape)


def _jumps(a: NDArray[np.float32], b: NDArray[np.float32], ratio: np.float32) -> NDArray[np.bool_]:
    """Where ``a`` and ``b`` differ by more than ``ratio`` of the greater."""
    most = np.maximum(a, b)
    most *= ratio
    gap = b - a
    found: NDArray[np.bool_] = np.abs(gap, out=gap) > most
    return found
