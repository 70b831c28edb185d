"""Thinned meshes keep the shape of the links."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from egovcp.log import meshes
from egovcp.log.meshes import link_meshes, thin
from egovcp.robot.kinematics import LINK_NAMES


def sphere(rows: int = 60) -> np.ndarray:
    """(F, 3, 3) triangles of the unit sphere."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, rows))
    p = np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1
    )
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
    faces = np.stack([np.stack([a, d, c], -2), np.stack([a, c, b], -2)])
    return faces.reshape(-1, 3, 3).astype(np.float32)


def test_simplified_vertices_stay_within_one_cell() -> None:
    corners = sphere()
    vertices, triangles = thin(corners, 0.2)
    assert len(triangles) < len(corners) / 5
    radii = np.linalg.norm(vertices, axis=1)
    assert radii.min() > 1 - 0.2
    assert radii.max() <= 1 + 1e-6
    assert triangles.max() == len(vertices) - 1


def test_a_fine_grid_changes_nothing() -> None:
    corners = sphere(8)
    vertices, triangles = thin(corners, 1e-4)
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    kept = vertices[triangles]
    after = np.linalg.norm(np.cross(kept[:, 1] - kept[:, 0], kept[:, 2] - kept[:, 0]), axis=1)
    assert after.sum() == pytest.approx(area.sum(), rel=1e-4)


@pytest.mark.skipif(importlib.util.find_spec("mjlab") is None, reason="needs the G1 model")
def test_every_visible_link_has_a_mesh() -> None:
    surfaces = link_meshes()
    assert set(surfaces) == set(LINK_NAMES)
    for name, mesh in surfaces.items():
        assert np.isfinite(mesh.vertices).all(), name
        assert np.abs(mesh.vertices).max() < 0.6, name
        lengths = np.linalg.norm(mesh.normals, axis=1)
        assert np.mean(np.abs(lengths - 1) < 1e-3) > 0.9, name  # but for folded-up vertices
    assert sum(len(mesh.triangles) for mesh in surfaces.values()) < 60_000


def test_without_the_model_there_are_no_meshes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert meshes.link_meshes() == {}
