"""Draws robot and scene as shaded triangles on the CPU with the painter's algorithm.

A point (x right, y up, z away) in camera coordinates projects to f (x, y) / z. Triangles are
painted from the farthest to the nearest, lit by one directional light.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.log.meshes import OBSTACLE, SPHERE, LinkMesh
from egovcp.log.pose import RobotPose
from egovcp.log.tick import SceneObject
from egovcp.robot.geometry import rotation_matrix
from egovcp.robot.kinematics import LINK_NAMES, PARENT

Array = NDArray[np.float64]

_LIGHT: Final = np.array([0.35, 0.45, 0.82])  # direction to the light, world
_AMBIENT: Final = 0.45
_FREE_M: Final = 0.3  # distance from the origin beyond which the viewpoint follows the robot
_OBSTACLE_OPACITY: Final = 0.45
_SKELETON: Final = (120, 122, 130)


@dataclass(frozen=True)
class Viewpoint:
    """Position, target and focal length of the virtual camera."""

    position: tuple[float, float, float] = (2.3, 3.3, 1.5)
    """World, m."""
    target: tuple[float, float, float] = (0.72, 0.0, 0.68)
    """World point at the image centre, m."""
    focal: float = 3.3
    """Focal length; half the image height spans distance / focal."""

    def following(self, pelvis_w: NDArray[np.floating]) -> Viewpoint:
        """The viewpoint moved horizontally with the pelvis (3,) m.

        It stays in place within `_FREE_M` of the origin, so that a stumble remains visible.
        """
        offset = np.array([*pelvis_w[:2], 0.0])
        shift = offset * max(0.0, 1.0 - _FREE_M / max(float(np.linalg.norm(offset)), 1e-9))
        position, target = (np.add(point, shift).tolist() for point in (self.position, self.target))
        return replace(self, position=tuple(position), target=tuple(target))

    def project(self, points_w: NDArray[np.floating]) -> tuple[Array, Array]:
        """(..., 3) world points -> image coordinates (..., 2) and depths (...)."""
        away = np.subtract(self.target, self.position)
        away = away / np.linalg.norm(away)
        right = np.cross(away, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        axes = np.stack([right, np.cross(right, away), away], axis=1)
        seen = (np.asarray(points_w, np.float64) - self.position) @ axes
        depth = np.maximum(seen[..., 2], 0.05)
        return self.focal * seen[..., :2] / depth[..., None], depth


@dataclass(frozen=True)
class Surface:
    """Triangles in the world."""

    corners_w: Array
    """(F, 3, 3) m."""
    colours: Array
    """(F, 3) RGB, 0 to 255."""
    opacity: float = 1.0
    """From 0 (invisible) to 1."""

    @property
    def normals(self) -> Array:
        """(F, 3) outward unit vectors."""
        a, b, c = self.corners_w[:, 0], self.corners_w[:, 1], self.corners_w[:, 2]
        normal = np.cross(b - a, c - a)
        unit: Array = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        return unit

    def facing(self, view: Viewpoint) -> Surface:
        """The triangles whose outside faces the viewpoint."""
        towards = np.subtract(view.position, self.corners_w[:, 0])
        seen = np.sum(self.normals * towards, axis=1) > 0
        return Surface(self.corners_w[seen], self.colours[seen], self.opacity)

    def shaded(self) -> Array:
        """(F, 4) RGB and opacity in [0, 1] under the light."""
        light = _AMBIENT + (1.0 - _AMBIENT) * np.clip(self.normals @ _LIGHT, 0.0, 1.0)
        colours = np.clip(self.colours / 255.0 * light[:, None], 0.0, 1.0)
        return np.column_stack([colours, np.full(len(colours), self.opacity)])


def robot_surface(pose: RobotPose, meshes: Mapping[str, LinkMesh]) -> list[Surface]:
    """The robot's links; one entry per link that has a mesh."""
    surfaces = []
    for i, name in enumerate(LINK_NAMES):
        if name in meshes:
            mesh = meshes[name]
            vertices = pose.positions_w[i] + mesh.vertices @ pose.rotations_w[i].T
            colours = mesh.colours[mesh.triangles[:, 0]].astype(np.float64)
            surfaces.append(Surface(vertices[mesh.triangles], colours))
    return surfaces


def scene_surface(scene: Iterable[SceneObject]) -> list[Surface]:
    """The objects of the scene; boxes are translucent."""
    surfaces = []
    for thing in scene:
        shape, colour, opacity = _box(), OBSTACLE, _OBSTACLE_OPACITY
        if thing.shape == "sphere":
            shape, colour, opacity = _sphere(), SPHERE, 1.0
        turned = (shape * thing.size) @ rotation_matrix(np.array(thing.quaternion_w)).T
        colours = np.tile(np.array(colour, np.float64), (len(shape), 1))
        surfaces.append(Surface(turned + thing.position_w, colours, opacity))
    return surfaces


def _box() -> Array:
    """(12, 3, 3) faces of the cube from -1 to 1, outward."""
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            u, v = np.eye(3)[(axis + 1) % 3], side * np.eye(3)[(axis + 2) % 3]
            centre = side * np.eye(3)[axis]
            a, b, c, d = (centre + p * u + q * v for p, q in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
            faces += [[a, b, c], [a, c, d]]
    return np.array(faces)


def _sphere(rings: int = 10) -> Array:
    """(F, 3, 3) faces of the unit sphere, outward."""
    polar = np.linspace(0.0, np.pi, rings)[:, None]
    around = np.linspace(0.0, 2.0 * np.pi, 2 * rings)[None]
    x, y = np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around)
    grid = np.stack([x, y, np.broadcast_to(np.cos(polar), x.shape)], axis=-1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    halves = [np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)]
    return np.concatenate([half.reshape(-1, 3, 3) for half in halves])


def paint(axes: Any, surfaces: list[Surface], view: Viewpoint) -> None:
    """Paint ``surfaces`` on matplotlib ``axes``, the farthest triangle first."""
    from matplotlib.collections import PolyCollection

    seen = [surface.facing(view) for surface in surfaces]
    points, depth = view.project(np.concatenate([surface.corners_w for surface in seen]))
    colours = np.concatenate([surface.shaded() for surface in seen])
    order = np.argsort(-depth.mean(axis=1))
    faces = PolyCollection(list(points[order]), facecolors=colours[order], edgecolors="face")
    faces.set_linewidth(np.where(colours[order, 3] < 1.0, 0.0, 0.2).tolist())  # no seams
    axes.add_collection(faces, autolim=False)


def paint_skeleton(axes: Any, pose: RobotPose, view: Viewpoint) -> None:
    """Draw the robot as lines between joints, for a machine without meshes."""
    points, _ = view.project(pose.positions_w)
    for child, parent in enumerate(PARENT):
        if parent >= 0:
            line = points[[parent, child]]
            axes.plot(
                *line.T, color=np.array(_SKELETON) / 255.0, linewidth=3, solid_capstyle="round"
            )


def paint_floor(
    axes: Any,
    view: Viewpoint,
    pelvis_w: NDArray[np.floating],
    extent: float = 3.0,
    spacing: float = 0.5,
) -> None:
    """Draw a grid on the ground around the robot. The lines stay fixed in the world, so that
    walking is visible."""
    middle = spacing * np.round(np.asarray(pelvis_w[:2]) / spacing)
    marks = np.arange(-extent, extent + spacing / 2, spacing)
    ends = np.array([-extent, extent])
    for mark in marks:
        for line in (np.stack([ends, np.full(2, mark)], 1), np.stack([np.full(2, mark), ends], 1)):
            points, _ = view.project(np.column_stack([line + middle, np.zeros(2)]))
            axes.plot(*points.T, color="0.85", linewidth=0.6, zorder=0)
