"""Draws robot and scene on matplotlib's 3D axes, without a GPU or a display."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.log.meshes import OBSTACLE, SPHERE, LinkMesh
from egovcp.log.pose import RobotPose, robot_pose
from egovcp.log.tick import Tick
from egovcp.robot.geometry import rotation_matrix
from egovcp.robot.kinematics import LINK_NAMES
from egovcp.robot_spec import G1, RobotSpec
from egovcp.spec import Solid

Array = NDArray[np.float64]

_CENTRE_X: Final = 0.55  # of the shown volume, m: in front of the robot
_HALF_WIDTH: Final = 1.0  # of the shown volume, m
_HEIGHT: Final = 1.4  # of the shown volume, m
_ELEVATION: Final = 12.0  # of the viewpoint, deg
_AZIMUTH: Final = 64.0
_LIGHT: Final = {"azdeg": 38.0, "altdeg": 55.0}
_STUMBLE_M: Final = 0.3  # distance from the origin beyond which the view follows the robot
_OBSTACLE_OPACITY: Final = 0.45
_SMALL_SCENE_M: Final = 0.5  # extent of what is shown of another robot than the G1


def draw_scene(
    axes: Any, tick: Tick, meshes: Mapping[str, LinkMesh], robot: RobotSpec = G1
) -> None:
    """Draw ground, robot and objects of a tick on 3D ``axes`` (see `AXES_OPTIONS`).

    Of another robot than the G1 only the scene is drawn, which may hold its links.
    """
    axes.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    axes.set_axis_off()
    if not robot.is_g1:
        points = np.array([thing.position_w for thing in tick.scene] or [np.zeros(3)])
        half = _SMALL_SCENE_M
        axes.set(xlim=(-half, 2 * half), ylim=(-1.5 * half, 1.5 * half))
        axes.set_zlim(0.0, max(half, float(points[:, 2].max())))
        axes.set_aspect("equal")
        _draw_faces(axes, [*scene_faces(tick.scene)])
        return
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    pose = robot_pose(tick)
    x, y = view_offset(pose.positions_w[0])
    x += _CENTRE_X
    axes.set(xlim=(x - _HALF_WIDTH, x + _HALF_WIDTH), ylim=(y - _HALF_WIDTH, y + _HALF_WIDTH))
    axes.set_zlim(0.0, _HEIGHT)
    axes.set_box_aspect((2 * _HALF_WIDTH, 2 * _HALF_WIDTH, _HEIGHT), zoom=1.7)
    ground = Line3DCollection(_ground(pose.positions_w[0]), colors="0.85", linewidths=0.6, zorder=0)
    axes.add_collection3d(ground)
    _draw_faces(axes, [*_robot(pose, meshes), *scene_faces(tick.scene)])


def _draw_faces(axes: Any, faces: Sequence[tuple[Array, Array]]) -> None:
    from matplotlib.colors import LightSource
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    if faces:
        seen = [_faces_viewer(corners) for corners, _ in faces]
        polygons = [p for (corners, _), k in zip(faces, seen, strict=True) for p in corners[k]]
        colours = np.concatenate([c[k] for (_, c), k in zip(faces, seen, strict=True)])
        light = LightSource(**_LIGHT)
        axes.add_collection3d(
            Poly3DCollection(
                polygons, facecolors=colours, shade=True, lightsource=light, antialiaseds=False
            )
        )


#: Options of `Figure.add_subplot` and `Figure.add_axes` for `draw_scene`.
AXES_OPTIONS: Final[Mapping[str, Any]] = {"projection": "3d", "computed_zorder": False}


def view_offset(pelvis_w: NDArray[np.floating]) -> tuple[float, float]:
    """Horizontal shift of the view that follows the pelvis (3,) m.

    It is zero within `_STUMBLE_M` of the origin, so that a stumble remains visible.
    """
    x, y = map(float, pelvis_w[:2])
    share = max(0.0, 1.0 - _STUMBLE_M / max(float(np.hypot(x, y)), 1e-9))
    return x * share, y * share


def _robot(pose: RobotPose, meshes: Mapping[str, LinkMesh]) -> Iterable[tuple[Array, Array]]:
    """Corners (F, 3, 3) in the world and RGBA (F, 4) of each link that has a mesh."""
    for i, name in enumerate(LINK_NAMES):
        if name in meshes:
            mesh = meshes[name]
            vertices = pose.positions_w[i] + mesh.vertices @ pose.rotations_w[i].T
            colours = mesh.colours[mesh.triangles[:, 0]] / 255.0
            yield vertices[mesh.triangles], np.insert(colours, 3, 1.0, axis=1)


def scene_faces(scene: Iterable[Solid]) -> Iterable[tuple[Array, Array]]:
    """Corners (F, 4, 3) in the world and RGBA (F, 4) of each object; boxes are translucent."""
    for thing in scene:
        if thing.shape == "sphere":
            shape, colour = _sphere(), (*np.divide(SPHERE, 255.0), 1.0)
        else:
            shape, colour = _box(), (*np.divide(OBSTACLE, 255.0), _OBSTACLE_OPACITY)
        turned = (shape * thing.size) @ rotation_matrix(thing.quaternion_w).T
        yield turned + thing.position_w, np.tile(colour, (len(shape), 1))


def _faces_viewer(corners: Array) -> NDArray[np.bool_]:
    """(F,) whether the outside of each of the faces (F, n, 3) is seen."""
    elevation, azimuth = np.radians([_ELEVATION, _AZIMUTH])
    horizontal = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
    normals = np.cross(corners[:, 2] - corners[:, 0], corners[:, -1] - corners[:, 1])
    seen: NDArray[np.bool_] = normals @ np.array([*horizontal, np.sin(elevation)]) > 0
    return seen


def _box() -> Array:
    """(6, 4, 3) faces of the cube from -1 to 1, outward."""
    faces = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            u, v = np.eye(3)[(axis + 1) % 3], side * np.eye(3)[(axis + 2) % 3]
            centre = side * np.eye(3)[axis]
            faces.append([centre - u - v, centre + u - v, centre + u + v, centre - u + v])
    return np.array(faces)


def _sphere(rings: int = 10) -> Array:
    """(F, 4, 3) faces of the unit sphere, outward."""
    polar = np.linspace(0.0, np.pi, rings)[:, None]
    around = np.linspace(0.0, 2.0 * np.pi, 2 * rings)[None]
    x, y = np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around)
    grid = np.stack([x, y, np.broadcast_to(np.cos(polar), x.shape)], axis=-1)
    corners = [grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]]
    return np.stack(corners, axis=-2).reshape(-1, 4, 3)


def _ground(pelvis_w: Array, extent: float = 3.0, spacing: float = 0.5) -> Array:
    """(n, 2, 3) lines of a grid around the robot, fixed in the world so that walking is visible."""
    middle = spacing * np.round(pelvis_w[:2] / spacing)
    marks = np.arange(-extent, extent + spacing / 2, spacing)
    first, last = np.full(len(marks), -extent), np.full(len(marks), extent)
    along_x = np.stack([np.stack([first, marks], 1), np.stack([last, marks], 1)], axis=1)
    lines: Array = np.concatenate([along_x, along_x[..., ::-1]]) + middle
    return np.concatenate([lines, np.zeros((len(lines), 2, 1))], axis=2)
