"""Casts the rays of a picture, and only those that can meet something.

Most pixels see the floor or nothing. A level floor at height z_f is met by the ray o + s d at
s = (z_f - o_z) / d_z, the very number that MuJoCo computes; everything else can only be met
inside the rectangle of pixels that its bounding box projects to. MuJoCo casts the rays of
those rectangles: a twentieth of all while the arms are the only thing in view.
"""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_GROUPS: Final = np.array([1, 0, 0, 1, 0, 0], dtype=np.uint8)
_UPRIGHT: Final = np.array([1.0, 0.0, 0.0, 0.0])
_SLACK: Final = 1e-3  # pixels and metres; rounding is a billionth of it
_CORNERS: Final = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


class Pinhole:
    """The pixel grid of a camera that looks along x; y is left, z is up."""

    def __init__(self, rows: int, columns: int, focal: float) -> None:
        self.shape = (rows, columns)
        self._focal = focal
        self._last = np.array([columns - 1.0, rows - 1.0])
        # inward normals of the planes that bound what the outermost pixels see
        wide, high = self._last / 2 / focal
        planes = np.array([[wide, 1, 0], [wide, -1, 0], [high, 0, 1], [high, 0, -1]])
        self._planes = (planes / np.linalg.norm(planes, axis=1, keepdims=True)).T.copy()

    def sees(self, centre: Array, radius: Array) -> NDArray[np.intp]:
        """Which of the spheres with centres (G, 3) (m, camera frame) may be in the picture."""
        inside = (centre @ self._planes).min(axis=1) > -radius - _SLACK
        return np.flatnonzero(inside)

    def cover(self, corners: Array) -> NDArray[np.bool_]:
        """(H, W) the pixels in which boxes with ``corners`` (G, 8, 3) (m, camera frame) can be."""
        covered = np.zeros(self.shape, dtype=np.bool_)
        ahead = corners[..., :1]
        where = self._last / 2 - self._focal * corners[..., 1:] / np.maximum(ahead, _SLACK)
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
        return covered


class View:
    """What a camera on a body of ``model`` can see: shapes and sizes as they are now.

    Args:
        model: geoms of groups 0 and 3 are visible.
        body: that carries the camera and stays unseen itself.
    """

    def __init__(self, model: mujoco.MjModel, body: int) -> None:
        self.model, self.body = model, body
        seen = _GROUPS.astype(np.bool_)[model.geom_group] & (model.geom_bodyid != body)
        plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self._floor = _level_floor(model, np.flatnonzero(seen & plane))
        self._solid = np.flatnonzero(seen & ~plane)
        self._radius = model.geom_rbound[self._solid].copy()
        box = model.geom_aabb[self._solid, None]
        self._corners = box[..., :3] + _CORNERS * box[..., 3:]

    def ranges(
        self,
        data: mujoco.MjData,
        pinhole: Pinhole,
        origin: Array,
        rotation: Array,
        rays: Array,
        cutoff: float,
    ) -> Array:
        """Range (H * W,) m to the first visible surface; negative or beyond ``cutoff``: none.

        Args:
            data: with current geom poses.
            pinhole: of the picture.
            origin: (3,) of all rays, m, world.
            rotation: (3, 3) from the camera frame to the world.
            rays: (H * W, 3) unit directions, world.
            cutoff: m, ranges beyond it do not matter.
        """
        if self._floor is None:
            return self._cast(data, origin, rays, cutoff)
        needed = self._needed(data, pinhole, origin, rotation)
        if len(needed) == len(rays):
            return self._cast(data, origin, rays, cutoff)
        out = _floor_range(self._floor, origin, rays)
        if len(needed):
            out[needed] = self._cast(data, origin, rays[needed], cutoff)
        return out

    def _needed(
        self, data: mujoco.MjData, pinhole: Pinhole, origin: Array, rotation: Array
    ) -> NDArray[np.intp]:
        """Indices of the pixels in which more than the floor may be."""
        centre = (data.geom_xpos[self._solid] - origin) @ rotation
        near = pinhole.sees(centre, self._radius)
        if len(near) == 0:
            return near
        turn = data.geom_xmat[self._solid[near]].reshape(-1, 3, 3).swapaxes(1, 2) @ rotation
        corners = self._corners[near] @ turn + centre[near, None]
        return np.flatnonzero(pinhole.cover(corners))

    def _cast(self, data: mujoco.MjData, origin: Array, rays: Array, cutoff: float) -> Array:
        """Ranges by MuJoCo alone."""
        count = len(rays)
        # fresh for each call, because threads share the camera
        geom, out = np.empty(count, dtype=np.int32), np.empty(count)
        mujoco.mj_multiRay(
            self.model, data, origin, rays.ravel(), _GROUPS, True, self.body,
            geom, out, None, count, cutoff,
        )  # fmt: skip
        return out


def _level_floor(model: mujoco.MjModel, planes: NDArray[np.intp]) -> float | None:
    """Height of the floor, m; minus infinity if there is none, None if it is not a simple one."""
    if len(planes) == 0:
        return -np.inf
    floor = planes[0]
    simple = len(planes) == 1 and model.geom_bodyid[floor] == 0
    level = (model.geom_quat[floor] == _UPRIGHT).all()
    if not simple or not level or (model.geom_size[floor, :2] > 0).any():
        return None
    return float(model.geom_pos[floor, 2])


def _floor_range(height: float, origin: Array, rays: Array) -> Array:
    """Range (H * W,) to a level floor; negative for rays that ascend, infinite from below."""
    drop = height - origin[2] if origin[2] >= height else -np.inf
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(drop / rays[:, 2])
