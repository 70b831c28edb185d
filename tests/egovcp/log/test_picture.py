"""The picture of a rollout shows the right moments and survives missing parts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from egovcp.errors import EnvironmentFailure
from egovcp.log.picture import (
    AHEAD,
    PictureSink,
    curves,
    depth_rows,
    imagined_of,
    key_frames,
    rollout_picture,
)
from egovcp.log.sketch import Surface, Viewpoint, paint, scene_surface
from egovcp.log.tick import RunInfo, SceneObject


def test_key_frames_span_the_events(make_tick: Any) -> None:
    ticks = [make_tick(i, bare=True) for i in range(60)]
    ticks[20] = replace(ticks[20], events=("ball thrown",))
    ticks[38] = replace(ticks[38], events=("blocked",))
    moments = key_frames(ticks, count=7)
    assert len(moments) == 7
    assert 15 <= moments[0] < 20
    assert 38 < moments[-1] < 50
    assert moments == sorted(moments)


@pytest.mark.parametrize("length", [1, 3, 60])
def test_key_frames_span_the_run_without_events(make_tick: Any, length: int) -> None:
    moments = key_frames([make_tick(0, bare=True)] * length)
    assert moments[0] == 0
    assert moments[-1] == length - 1
    assert len(set(moments)) == len(moments) == min(length, 7)


def test_imagined_images_are_shown_at_the_tick_they_predict(make_tick: Any) -> None:
    bare = make_tick(0, bare=True)
    film = lambda i: np.full((AHEAD, 48, 64), 100.0 * i) + np.arange(AHEAD)[:, None, None]  # noqa: E731
    ticks = [replace(bare, depth_imagined=film(i)) for i in range(AHEAD + 3)]
    shown = imagined_of(ticks, AHEAD + 2)
    assert shown is not None
    assert np.unique(shown).tolist() == [100.0 * 2 + AHEAD - 1]
    assert imagined_of(ticks, AHEAD - 1) is None


def test_missing_data_has_neither_row_nor_curve(make_tick: Any) -> None:
    ticks = [make_tick(i, bare=True) for i in range(AHEAD + 2)]
    last = len(ticks) - 1
    assert list(depth_rows(ticks, [0, last])) == ["depth seen"]
    assert list(curves(ticks)) == ["return so far"]
    ticks[-1] = replace(ticks[-1], depth_reconstructed=np.ones((48, 64)), value=0.5)
    assert list(depth_rows(ticks, [0, last])) == ["depth seen", "reconstructed"]
    assert list(depth_rows(ticks, [0])) == ["depth seen"]
    assert list(curves(ticks)) == ["value of the plan", "return so far"]
    ticks[last - AHEAD] = replace(ticks[last - AHEAD], depth_imagined=np.ones((AHEAD, 48, 64)))
    assert len(depth_rows(ticks, [0, last])) == 3


def test_fewer_rows_make_a_lower_picture(tmp_path: Path, make_tick: Any) -> None:
    sizes = []
    for bare in (False, True):
        path = tmp_path / f"{bare}.png"
        rollout_picture([make_tick(i, bare=bare) for i in range(2)], path)
        with Image.open(path) as image:
            sizes.append(image.size)
    assert sizes[0][0] == sizes[1][0]
    assert sizes[0][1] > sizes[1][1] + 100


@pytest.mark.parametrize("bare", [False, True])
def test_close_writes_the_picture(tmp_path: Path, make_tick: Any, bare: bool) -> None:
    path = tmp_path / "a.png"
    sink = PictureSink(path)
    sink.open(RunInfo("ball"))
    sink.write(make_tick(0, bare=bare))
    assert not path.exists()
    sink.close()
    sink.close()
    with Image.open(path) as image:
        assert min(image.size) > 200
        assert len(image.convert("L").getcolors()) > 20


def test_a_picture_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"precious")
    with pytest.raises(EnvironmentFailure, match="exists already"):
        PictureSink(tmp_path / "a.png").open(RunInfo("ball"))


def test_the_target_projects_to_the_centre() -> None:
    eye = Viewpoint(position=(-3.0, 0.0, 1.0), target=(0.0, 0.0, 1.0))
    points, depth = eye.project(np.array([[0.0, 0.0, 1.0], [0.0, 0.5, 1.0], [0.0, 0.0, 1.5]]))
    np.testing.assert_allclose(points[0], 0.0, atol=1e-12)
    assert depth[0] == pytest.approx(3.0)
    assert points[1, 0] < 0
    assert points[1, 1] == pytest.approx(0.0)
    assert points[2, 1] > 0


@pytest.mark.parametrize("way", [(8.0, 0.0), (0.0, -5.0), (-3.0, 4.0)])
def test_the_viewpoint_follows_walking_but_not_stumbling(
    way: tuple[float, float],
) -> None:
    stumble = np.array(way) / np.hypot(*way) * 0.2
    assert Viewpoint().following(np.array([*stumble, 0.74])) == Viewpoint()
    for share in (0.2, 0.5, 1.0):
        pelvis = np.array([way[0] * share, way[1] * share, 0.74])
        eye = Viewpoint().following(pelvis)
        (points, _) = eye.project(pelvis[None])
        assert np.all(np.abs(points) < [0.85, 0.5]), "it stays in the picture"
        moved = np.subtract(eye.target, Viewpoint().target)
        np.testing.assert_allclose(np.subtract(eye.position, Viewpoint().position), moved)
        assert moved[2] == 0.0


@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_solids_are_closed_and_face_outwards(shape: Any) -> None:
    thing = SceneObject("a", shape, (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), (0.2, 0.2, 0.2))
    (surface,) = scene_surface([thing])
    outward = surface.corners_w.mean(axis=1) - (1.0, 2.0, 3.0)
    areas = np.linalg.norm(
        np.cross(
            surface.corners_w[:, 1] - surface.corners_w[:, 0],
            surface.corners_w[:, 2] - surface.corners_w[:, 0],
        ),
        axis=1,
    )
    assert np.all(np.sum(surface.normals * outward, axis=1)[areas > 1e-9] > 0)
    volume = np.sum(np.linalg.det(surface.corners_w - np.array([1.0, 2.0, 3.0]))) / 6
    assert volume == pytest.approx(0.4**3 if shape == "box" else 4.19 * 0.2**3, rel=0.1)


def test_nearer_triangles_are_painted_over_farther_ones() -> None:
    near = np.array([[[0.0, -1, 0], [0.0, 1, 0], [0.0, 0, 1]]])
    far = near + np.array([1.0, 0.0, 0.0])
    eye = Viewpoint(position=(-3.0, 0.0, 0.3), target=(0.0, 0.0, 0.3))
    surfaces = [
        Surface(near[:, ::-1], np.array([[255.0, 0, 0]])),
        Surface(far[:, ::-1], np.array([[0, 0, 255.0]])),
    ]
    axes = Figure().subplots()
    paint(axes, surfaces, eye)
    colours = axes.collections[0].get_facecolor()
    assert colours[0][2] > colours[0][0], "the far, blue triangle comes first"
    assert colours[-1][0] > colours[-1][2]


@pytest.mark.parametrize(("shape", "hides"), [("sphere", True), ("box", False)])
def test_a_ball_hides_what_is_behind_it_and_a_wall_does_not(shape: Any, hides: bool) -> None:
    thing = SceneObject("a", shape, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.3, 0.3, 0.3))
    eye = Viewpoint(position=(-3.0, 0.0, 0.0), target=(0.0, 0.0, 0.0))
    middles = []
    for behind in ((255.0, 0.0, 0.0), (0.0, 0.0, 255.0)):
        corners = np.array([[[1.0, 0.9, -0.9], [1.0, -0.9, -0.9], [1.0, 0.0, 0.9]]])
        figure = Figure(figsize=(1, 1))
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(-1, 1), ylim=(-1, 1))
        paint(axes, [Surface(corners, np.array([behind])), *scene_surface([thing])], eye)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        picture = np.asarray(canvas.buffer_rgba())
        middles.append(picture[picture.shape[0] // 2, picture.shape[1] // 2, :3].astype(int))
    seen = np.abs(middles[0] - middles[1]).max()
    assert (seen < 30) == hides, "the seams between triangles let a little through"
