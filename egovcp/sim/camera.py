"""Depth images by ray casting: planar depth, and the faults of a stereo camera.

The depth of a hit at range s along the ray d/|d| of a pixel (`egovcp.robot.geometry`) is its
coordinate along the optical axis, z = s / |d|.

Only rays that can hit something besides the floor are cast. The ray o + s d hits a level floor at
height z_f at s = (z_f - o_z) / d_z, as MuJoCo computes it; any other geom is inside the rectangle
of pixels that its bounding box projects to.
"""

from __future__ import annotations

import math
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.robot.geometry import focal_length, pixel_rays
from egovcp.sim.config import CameraConfig
from egovcp.spec import DEPTH_COLS, DEPTH_MAX_M, DEPTH_MIN_M, DEPTH_ROWS

Array = NDArray[np.float64]

_VISIBLE_GROUPS: Final = np.array([1, 0, 0, 1, 0, 0], dtype=np.uint8)
_IDENTITY_QUAT: Final = np.array([1.0, 0.0, 0.0, 0.0])
_SLACK: Final = 1e-3  # pixels and metres; rounding is a billionth of it
_CORNERS: Final = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


class RayCaster:
    """The geoms of ``model`` that a camera on one of its bodies sees; their shapes are read once.

    Args:
        model: geoms of groups 0 and 3 are visible.
        body: carries the camera, and is itself invisible.
    """

    def __init__(self, model: mujoco.MjModel, body: int) -> None:
        self.model, self.body = model, body
        seen = _VISIBLE_GROUPS.astype(np.bool_)[model.geom_group] & (model.geom_bodyid != body)
        plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self.floor = _level_floor(model, np.flatnonzero(seen & plane))
        self.solid = np.flatnonzero(seen & ~plane)  # (G,) ids of the geoms besides the floor
        self.radius = model.geom_rbound[self.solid].copy()  # (G,) m
        box = model.geom_aabb[self.solid, None]
        self.corners = box[..., :3] + _CORNERS * box[..., 3:]  # (G, 8, 3) m, geom frame

    def cast(self, data: mujoco.MjData, origin: Array, rays: Array, cutoff: float) -> Array:
        """Ranges (n,) m along ``rays`` (n, 3), world, by MuJoCo; negative or beyond ``cutoff``:
        none."""
        count = len(rays)
        # fresh for each call, because threads share the camera
        geom, out = np.empty(count, dtype=np.int32), np.empty(count)
        mujoco.mj_multiRay(
            self.model, data, origin, rays.ravel(), _VISIBLE_GROUPS, True, self.body,
            geom, out, None, count, cutoff,
        )  # fmt: skip
        return out


def _level_floor(model: mujoco.MjModel, planes: NDArray[np.intp]) -> float | None:
    """Height of the floor, m; -inf: no floor, None: not a single level infinite plane."""
    if len(planes) == 0:
        return -np.inf
    floor = planes[0]
    simple = len(planes) == 1 and model.geom_bodyid[floor] == 0
    level = (model.geom_quat[floor] == _IDENTITY_QUAT).all()
    if not simple or not level or (model.geom_size[floor, :2] > 0).any():
        return None
    return float(model.geom_pos[floor, 2])


def _floor_range(height: float, origin: Array, rays: Array) -> Array:
    """Range (H * W,) to a level floor; negative for rays that ascend, infinite from below."""
    drop = height - origin[2] if origin[2] >= height else -np.inf
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(drop / rays[:, 2])


class RayCastCamera:
    """Renders depth images by ray casting from a mount on the torso."""

    def __init__(self, config: CameraConfig) -> None:
        self.position = np.array(config.position)
        self.focal = focal_length(config.vertical_fov)
        rays = pixel_rays(self.focal)
        self._axial = 1.0 / np.linalg.norm(rays, axis=1)  # cosine to the optical axis
        self._directions = rays * self._axial[:, None]
        self._cutoff = DEPTH_MAX_M / float(self._axial.min())
        self._last = np.array([DEPTH_COLS - 1.0, DEPTH_ROWS - 1.0])
        # inward normals of the planes that bound what the outermost pixels see
        wide, high = self._last / 2 / self.focal
        planes = np.array([[wide, 1, 0], [wide, -1, 0], [high, 0, 1], [high, 0, -1]])
        self._planes = (planes / np.linalg.norm(planes, axis=1, keepdims=True)).T.copy()

    def pose(
        self, data: mujoco.MjData, torso_body: int, pitch: float
    ) -> tuple[Array, NDArray[np.float64]]:
        """Position (3,) and rotation (3, 3) of the camera in the world; x is the optical axis."""
        torso = data.xmat[torso_body].reshape(3, 3)
        c, s = math.cos(pitch), math.sin(pitch)
        tilt = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return data.xpos[torso_body] + torso @ self.position, torso @ tilt

    def render(self, caster: RayCaster, data: mujoco.MjData, pitch: float) -> NDArray[np.float32]:
        """True planar depth (H, W), m; 0 where nothing is within the camera's range.

        Args:
            caster: of the body that carries the camera.
            data: with current body poses (``mj_kinematics``).
            pitch: rad below the body's horizontal.
        """
        origin, rotation = self.pose(data, caster.body, pitch)
        rays = self._directions @ np.ascontiguousarray(rotation.T)
        if caster.floor is None:
            ranges = caster.cast(data, origin, rays, self._cutoff)
        else:
            ranges = _floor_range(caster.floor, origin, rays)
            needed = self._covered(caster, data, origin, rotation)
            if len(needed):
                ranges[needed] = caster.cast(data, origin, rays[needed], self._cutoff)
        ranges *= self._axial
        return within_range(ranges.astype(np.float32)).reshape(DEPTH_ROWS, DEPTH_COLS)

    def _covered(
        self, caster: RayCaster, data: mujoco.MjData, origin: Array, rotation: Array
    ) -> NDArray[np.intp]:
        """Indices of the pixels in which more than the floor may be."""
        centre = (data.geom_xpos[caster.solid] - origin) @ rotation
        near = np.flatnonzero((centre @ self._planes).min(axis=1) > -caster.radius - _SLACK)
        if len(near) == 0:
            return near
        turn = data.geom_xmat[caster.solid[near]].reshape(-1, 3, 3).swapaxes(1, 2) @ rotation
        corners = caster.corners[near] @ turn + centre[near, None]  # (G, 8, 3) m, camera frame
        covered = np.zeros((DEPTH_ROWS, DEPTH_COLS), dtype=np.bool_)
        ahead = corners[..., :1]
        where = self._last / 2 - self.focal * corners[..., 1:] / np.maximum(ahead, _SLACK)
        low = np.ceil(np.maximum(where.min(axis=1), 0.0) - _SLACK)
        high = np.floor(np.minimum(where.max(axis=1), self._last) + _SLACK) + 1.0
        # a box that reaches behind the camera has no bounded projection
        bounded = ahead.min(axis=(1, 2)) > _SLACK
        for i, ((left, top), (right, bottom)) in enumerate(
            zip(low.astype(int).tolist(), high.astype(int).tolist(), strict=True)
        ):
            if not bounded[i]:
                covered[:] = True
            elif right > left and bottom > top:
                covered[top:bottom, left:right] = True
        return np.flatnonzero(covered)


def within_range(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """``depth`` in metres with 0 wherever the camera would measure nothing."""
    valid = (depth >= DEPTH_MIN_M) & (depth <= DEPTH_MAX_M)
    return np.where(valid, depth, np.float32(0))


class DepthNoise:
    """Noise that grows with z^2, holes and lost edges, of one camera in one episode."""

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
        measured = within_range(np.where(lost, np.float32(0), noise))
        measured *= 1000.0
        return np.rint(measured, out=measured).astype(np.uint16)


def discontinuity(depth: NDArray[np.float32], ratio: np.float32) -> NDArray[np.bool_]:
    """(H, W) pixels beside a jump of more than ``ratio`` of the greater depth.

    The border of invalid pixels (0) counts as one.
    """
    width = depth.shape[1]
    flat = np.ascontiguousarray(depth).reshape(-1)
    across = _jumps(flat[:-1], flat[1:], ratio)
    across[width - 1 :: width] = False  # row ends are not neighbours
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
