"""Casts the rays of a pinhole picture, and only those that can meet something.

Most pixels see the floor or nothing. A level floor at height z_f is met by the ray o + s d at
s = (z_f - o_z) / d_z, the very number that MuJoCo computes; everything else can only be met
inside the rectangle of pixels that its bounding box projects to. MuJoCo casts the rays of
those rectangles, which are a fifth of all rays while the arms are the only thing in view.
"""

from __future__ import annotations

from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_GROUPS: Final = np.array([1, 0, 0, 1, 0, 0], dtype=np.uint8)
_IN_GROUP: Final = _GROUPS.astype(np.bool_)
_LEVEL: Final = np.eye(3).ravel()
_SLACK: Final = 1e-3  # pixels and metres; rounding is a billionth of it
_CORNERS: Final = np.array(
    [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
)


class Pinhole:
    """The pixel grid of a camera that looks along x: y is left, z is up."""

    def __init__(self, rows: int, columns: int, focal: float) -> None:
        self.rows, self.columns, self.focal = rows, columns, focal
        self._middle = np.array([(columns - 1) / 2, (rows - 1) / 2])
        # inward normals of the planes that bound what the outermost pixels see
        wide, high = self._middle / focal
        planes = np.array([[wide, 1, 0], [wide, -1, 0], [high, 0, 1], [high, 0, -1]])
        self._planes = (planes / np.linalg.norm(planes, axis=1, keepdims=True)).T

    def sees(self, centre: Array, radius: Array) -> NDArray[np.intp]:
        """Which of the spheres with centres (G, 3) (m, camera frame) may be in the picture."""
        inside = (centre @ self._planes).min(axis=1) > -radius - _SLACK
        return np.flatnonzero(inside)

    def rectangles(self, corners: Array) -> list[tuple[slice, slice]]:
        """(rows, columns) of the pixels that each box with corners (G, 8, 3) can cover."""
        ahead = corners[..., :1]
        where = self._middle - self.focal * corners[..., 1:] / np.maximum(ahead, _SLACK)
        # a box that reaches behind the camera has no bounded projection
        bounded = ahead.min(axis=(1, 2)) > _SLACK
        low = np.where(bounded[:, None], np.ceil(where.min(axis=1) - _SLACK), 0)
        high = np.where(bounded[:, None], np.floor(where.max(axis=1) + _SLACK), np.inf)
        low = np.maximum(low, 0).astype(np.intp)
        high = np.clip(high, -1, [self.columns - 1, self.rows - 1]).astype(np.intp) + 1
        return [
            (slice(top, bottom), slice(left, right))
            for (left, top), (right, bottom) in zip(low.tolist(), high.tolist(), strict=True)
        ]


def cast(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    pinhole: Pinhole,
    origin: Array,
    rotation: Array,
    rays: Array,
    excluded: int,
    cutoff: float,
) -> Array:
    """Range (H * W,) m along each ray to the first visible geom; negative or beyond ``cutoff``
    where there is none.

    Args:
        model: with the geoms; those of groups 0 and 3 are visible.
        data: with current geom poses.
        pinhole: of the picture.
        origin: (3,) of all rays, m, world.
        rotation: (3, 3) from the camera frame to the world.
        rays: (H * W, 3) unit directions, world.
        excluded: body that is not seen.
        cutoff: m, ranges beyond it do not matter.
    """
    solid, planes = _visible(model, excluded)
    floor = _level_floor(model, data, planes)
    if floor is None:
        return _cast(model, data, origin, rays, excluded, cutoff)
    needed = _covered(model, data, pinhole, solid, origin, rotation)
    if len(needed) == len(rays):
        return _cast(model, data, origin, rays, excluded, cutoff)
    out = _floor_range(floor, origin, rays)
    if len(needed):
        out[needed] = _cast(model, data, origin, rays[needed], excluded, cutoff)
    return out


def _visible(model: mujoco.MjModel, excluded: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Geoms that rays can meet: bodies and planes."""
    seen = _IN_GROUP[model.geom_group] & (model.geom_bodyid != excluded)
    plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    return np.flatnonzero(seen & ~plane), np.flatnonzero(seen & plane)


def _level_floor(
    model: mujoco.MjModel, data: mujoco.MjData, planes: NDArray[np.intp]
) -> float | None:
    """Height of the floor, m; minus infinity if there is none, None if it is not a simple one."""
    if len(planes) == 0:
        return -np.inf
    level = len(planes) == 1 and (data.geom_xmat[planes[0]] == _LEVEL).all()
    if not level or (model.geom_size[planes[0], :2] > 0).any():
        return None
    return float(data.geom_xpos[planes[0], 2])


def _covered(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    pinhole: Pinhole,
    geoms: NDArray[np.intp],
    origin: Array,
    rotation: Array,
) -> NDArray[np.intp]:
    """Indices of the pixels in which any of ``geoms`` may be."""
    centre = (data.geom_xpos[geoms] - origin) @ rotation
    near = pinhole.sees(centre, model.geom_rbound[geoms])
    covered = np.zeros((pinhole.rows, pinhole.columns), dtype=np.bool_)
    if len(near):
        which = geoms[near]
        box = model.geom_aabb[which]
        local = box[:, None, :3] + _CORNERS * box[:, None, 3:]
        turn = rotation.T @ data.geom_xmat[which].reshape(-1, 3, 3)
        corners = local @ turn.swapaxes(1, 2) + centre[near, None]
        for area in pinhole.rectangles(corners):
            covered[area] = True
    return np.flatnonzero(covered)


def _floor_range(height: float, origin: Array, rays: Array) -> Array:
    """Range (H * W,) to a level floor; negative for rays that ascend, infinite from below."""
    drop = height - origin[2] if origin[2] >= height else -np.inf
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(drop / rays[:, 2])


def _cast(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    origin: Array,
    rays: Array,
    excluded: int,
    cutoff: float,
) -> Array:
    """Ranges by MuJoCo alone."""
    count = len(rays)
    geom, out = np.empty(count, dtype=np.int32), np.empty(count)
    mujoco.mj_multiRay(
        model, data, origin, rays.ravel(), _GROUPS, True, excluded, geom, out, None, count, cutoff
    )
    return out
