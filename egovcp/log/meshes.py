"""Simplified meshes of the G1's links, and the colours of drawings.

The meshes come from the model in the mjlab wheel (binary STL and the ``visual`` geoms of the MJCF),
without a simulator. Merging vertices on a grid reduces 390 000 triangles (19 MB) to a tenth.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure
from egovcp.robot.g1 import model_path

GRID_M: Final = 0.008
_STL_HEADER_BYTES: Final = 84
_STL_TRIANGLE: Final = np.dtype([("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("_", "<u2")])
_DARK: Final = (60, 60, 65)
_LIGHT: Final = (190, 192, 198)
#: Viridis at 0, 1/4, 1/2, 3/4 and 1.
_STOPS: Final = np.array(
    [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], np.float64
)
LEFT: Final = (230, 97, 1)
RIGHT: Final = (94, 60, 153)
SPHERE: Final = (214, 39, 40)
OBSTACLE: Final = (150, 140, 120)


@dataclass(frozen=True)
class LinkMesh:
    """Triangles of one link in its own frame."""

    vertices: NDArray[np.float32]
    """(V, 3) m."""
    triangles: NDArray[np.uint32]
    """(F, 3) indices of vertices, counter-clockwise seen from outside."""
    normals: NDArray[np.float32]
    """(V, 3) outward unit vectors."""
    colours: NDArray[np.uint8]
    """(V, 3) RGB."""


def link_meshes(grid: float = GRID_M) -> dict[str, LinkMesh]:
    """Link name -> mesh; empty where the model is not installed, for example on a robot.

    Args:
        grid: vertices within one cell of this size, m, become one.
    """
    try:
        path = model_path()
    except EnvironmentFailure:
        return {}
    return _load(path, grid)


@cache
def _load(path: Path, grid: float) -> dict[str, LinkMesh]:
    root = ElementTree.parse(path).getroot()
    files = {m.attrib["name"]: path.parent / "assets" / m.attrib["file"] for m in root.iter("mesh")}
    meshes = {}
    for body in root.iter("body"):
        geoms = [g for g in body.findall("geom") if g.get("class") == "visual"]
        if geoms:
            parts = [_geom(geom, files[geom.attrib["mesh"]], grid) for geom in geoms]
            meshes[body.attrib["name"]] = _merge(parts)
    return meshes


def _geom(geom: ElementTree.Element, file: Path, grid: float) -> LinkMesh:
    """One simplified visual geom in the frame of its link (no geom of the G1 is rotated)."""
    vertices, triangles = thin(_read_stl(file), grid)
    offset = np.array(geom.get("pos", "0 0 0").split(), np.float32)
    colour = _DARK if geom.get("material") == "black" else _LIGHT
    return LinkMesh(
        vertices + offset,
        triangles,
        _normals(vertices, triangles),
        np.tile(np.array(colour, np.uint8), (len(vertices), 1)),
    )


def _read_stl(file: Path) -> NDArray[np.float32]:
    """(F, 3, 3) corners of the triangles of a binary STL."""
    corners: NDArray[np.float32] = np.frombuffer(
        file.read_bytes(), _STL_TRIANGLE, offset=_STL_HEADER_BYTES
    )["vertices"]
    return corners


def thin(
    corners: NDArray[np.float32], grid: float
) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Triangles (F, 3, 3) -> (V, 3) vertices and (F', 3) indices, one vertex per grid cell.

    The vertex of a cell is the mean of its vertices. Triangles in fewer than three cells and
    repeated triangles are removed.
    """
    points = corners.reshape(-1, 3)
    cells = np.round(points / grid).astype(np.int64)
    _, index, count = np.unique(_keys(cells), return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(index, points[:, k]) for k in range(3)], axis=1)
    triangles = index.reshape(-1, 3)
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (a != c)]
    _, first = np.unique(_keys(triangles), return_index=True)
    used, triangles = np.unique(triangles[first], return_inverse=True)
    vertices = (sums[used] / count[used, None]).astype(np.float32)
    return vertices, triangles.reshape(-1, 3).astype(np.uint32)


def _keys(rows: NDArray[np.integer]) -> NDArray[np.int64]:
    """(n, 3) integers -> (n,), one number per distinct row."""
    shifted = rows.astype(np.int64) - rows.min(axis=0, initial=0)
    spans = shifted.max(axis=0, initial=0) + 1
    keys: NDArray[np.int64] = (shifted[:, 0] * spans[1] + shifted[:, 1]) * spans[2] + shifted[:, 2]
    return keys


def _normals(vertices: NDArray[np.float32], triangles: NDArray[np.uint32]) -> NDArray[np.float32]:
    """(V, 3) mean normal of the triangles at each vertex, weighted by their area."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    faces = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(total, triangles[:, k], faces)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.asarray(total / np.maximum(length, 1e-12), np.float32)


def _merge(parts: list[LinkMesh]) -> LinkMesh:
    starts = np.cumsum([0, *[len(part.vertices) for part in parts[:-1]]])
    return LinkMesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([p.triangles + np.uint32(s) for p, s in zip(parts, starts, strict=True)]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.colours for part in parts]),
    )


def value_colours(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """(n,) values -> (n, 3) RGB, from dark blue for the lowest to yellow for the highest."""
    v = np.nan_to_num(np.asarray(values, np.float64))
    span = float(v.max() - v.min()) if v.size else 0.0
    share = (v - v.min()) / span if span > 0 else np.ones_like(v)
    at = np.linspace(0.0, 1.0, len(_STOPS))
    mixed: NDArray[np.float64] = np.stack(
        [np.interp(share, at, stops) for stops in _STOPS.T], axis=1
    )
    return np.rint(mixed).astype(np.uint8)
