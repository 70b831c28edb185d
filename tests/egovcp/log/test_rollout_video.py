"""Images and videos of a rollout show the right moments and survive missing parts."""

from __future__ import annotations

import pickle
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image, ImageSequence

from egovcp.errors import EnvironmentFailure
from egovcp.log import rollout_video
from egovcp.log.rollout_video import (
    AHEAD,
    SIZE,
    STRIDE,
    RolloutVideoSink,
    curves,
    depth_rows,
    key_frames,
    video_frames,
    write_key_frames,
    write_videos,
)
from egovcp.log.scene_plot import scene_faces, view_offset
from egovcp.log.tick import RunInfo
from egovcp.robot_spec import G1
from egovcp.spec import Solid


def test_key_frames_span_the_events(make_tick: Any) -> None:
    ticks = [make_tick(i, bare=True) for i in range(60)]
    ticks[20] = replace(ticks[20], events=("ball thrown",))
    ticks[38] = replace(ticks[38], events=("blocked",))
    moments = key_frames(ticks)
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


def test_imagined_images_are_shown_at_the_tick_they_predict(
    make_tick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: dict[int, float] = {}

    def draw(ticks: Any, imagined: Any, *rest: object) -> None:
        rows = depth_rows(ticks, imagined, G1)
        (row,) = [row for name, row in rows.items() if "imagined" in name]
        shown.update(
            (tick.index, image[0, 0])
            for tick, image in zip(ticks, row, strict=True)
            if image is not None
        )

    monkeypatch.setattr(rollout_video, "write_key_frames", draw)
    sink = RolloutVideoSink(Path("a.png"))
    for i in (0, 1, 2, AHEAD, AHEAD + 2, AHEAD + 3):  # the others are missing
        film = 100.0 * i + np.ones((2 * AHEAD, 48, 64)).cumsum(0)
        sink.write(replace(make_tick(i, bare=True), depth_imagined=film))
    sink.close()
    assert shown == {AHEAD: AHEAD, AHEAD + 2: 200 + AHEAD}


def test_missing_data_has_neither_row_nor_curve(make_tick: Any) -> None:
    ticks = [make_tick(i, bare=True) for i in range(AHEAD + 2)]
    assert list(depth_rows(ticks, {}, G1)) == ["depth seen"]
    assert list(curves(ticks)) == ["return so far"]
    ticks[-1] = replace(ticks[-1], depth_reconstructed=np.ones((48, 64)), value=0.5)
    assert list(depth_rows(ticks, {}, G1)) == ["depth seen", "reconstructed"]
    assert list(depth_rows(ticks[:1], {}, G1)) == ["depth seen"]
    assert list(curves(ticks)) == ["value of the plan", "return so far"]
    assert len(depth_rows(ticks, {ticks[-1].index: np.ones((48, 64))}, G1)) == 3


def test_fewer_rows_make_a_lower_image(tmp_path: Path, make_tick: Any) -> None:
    sizes = []
    for bare in (False, True):
        path = tmp_path / f"{bare}.png"
        write_key_frames([make_tick(i, bare=bare) for i in range(2)], {}, path, "", G1)
        with Image.open(path) as image:
            sizes.append(image.size)
    assert sizes[0][0] == sizes[1][0]
    assert sizes[0][1] > sizes[1][1] + 100


@pytest.mark.parametrize("bare", [False, True])
def test_close_writes_the_key_frames(tmp_path: Path, make_tick: Any, bare: bool) -> None:
    path = tmp_path / "a.png"
    sink = RolloutVideoSink(path)
    sink.open(RunInfo("ball"))
    sink.write(make_tick(0, bare=bare))
    assert not path.exists()
    sink.close()
    sink.close()
    with Image.open(path) as image:
        assert min(image.size) > 200
        assert len(image.convert("L").getcolors()) > 20


def test_only_what_is_shown_is_kept(make_tick: Any) -> None:
    images = np.zeros((2 * AHEAD, 48, 64))
    kept, image_bytes = weakref.ref(images), images[0].nbytes
    sink = RolloutVideoSink()
    sink.write(replace(make_tick(0), depth_imagined=images))
    del images
    assert kept() is None
    assert len(pickle.dumps(sink)) < 3 * image_bytes


def test_a_file_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"precious")
    with pytest.raises(EnvironmentFailure, match="exists already"):
        RolloutVideoSink(tmp_path / "a.png").open(RunInfo("ball"))


@pytest.mark.parametrize("way", [(8.0, 0.0), (0.0, -5.0), (-3.0, 4.0)])
def test_the_view_follows_walking_but_not_stumbling(way: tuple[float, float]) -> None:
    stumble = np.array(way) / np.hypot(*way) * 0.2
    assert view_offset(np.array([*stumble, 0.74])) == (0.0, 0.0)
    for share in (0.2, 0.5, 1.0):
        pelvis = np.array([way[0] * share, way[1] * share, 0.74])
        assert np.hypot(*(pelvis[:2] - view_offset(pelvis))) == pytest.approx(0.3)


@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_solids_are_closed_and_face_outwards(shape: Any) -> None:
    thing = Solid(
        "a", shape, (0.2, 0.2, 0.2), np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0, 0.0])
    )
    ((corners, _),) = scene_faces([thing])
    a, b, c, d = (corners - (1.0, 2.0, 3.0)).transpose(1, 0, 2)
    normals = np.cross(c - a, d - b)
    assert np.all(np.sum(normals * (a + b + c + d), axis=1) > 0)
    volume = sum(np.linalg.det(np.stack(half, axis=1)).sum() for half in ((a, b, c), (a, c, d))) / 6
    assert volume == pytest.approx(0.4**3 if shape == "box" else 4.19 * 0.2**3, rel=0.1)


def test_frames_change_with_the_depth_image(make_tick: Any) -> None:
    ticks = [make_tick(i, bare=False) for i in range(2 * STRIDE)]
    first, second = video_frames(ticks, {}, G1)
    assert first.shape == (SIZE[1], SIZE[0], 3)
    assert (first != second).any()
    assert len(np.unique(first)) > 20


def write_six_ticks(path: Path, make_tick: Any, bare: bool) -> Path:
    """A video of six ticks."""
    sink = RolloutVideoSink(path)
    sink.open(RunInfo("ball"))
    for i in range(6):
        sink.write(make_tick(i, bare=bare))
    sink.close()
    return path


@pytest.mark.parametrize("bare", [False, True])
def test_a_gif_has_one_frame_per_stride(tmp_path: Path, make_tick: Any, bare: bool) -> None:
    path = write_six_ticks(tmp_path / "a.gif", make_tick, bare)
    with Image.open(path) as image:
        assert image.size == SIZE
        assert image.info["duration"] == 80
        assert 1 < image.n_frames <= 3  # type: ignore[attr-defined]


def test_a_gif_has_the_speed_of_the_robot(
    tmp_path: Path, make_tick: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.gif"
    steps = (np.full((8, 8, 3), 20 * i, np.uint8) for i in range(9))
    monkeypatch.setattr(rollout_video, "video_frames", lambda *arguments: steps)
    write_videos([], {}, [path], replace(G1, planner_hz=30))
    durations = []
    with Image.open(path) as image:
        for frame in ImageSequence.Iterator(image):
            durations.append(frame.info["duration"])
    assert durations == [70, 60, 70] * 3


def test_an_mp4_has_the_same_frames(tmp_path: Path, make_tick: Any) -> None:
    path = write_six_ticks(tmp_path / "a.mp4", make_tick, bare=False)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == SIZE
        assert float(stream.average_rate or 0) == 12.5
        assert sum(1 for _ in container.decode(video=0)) == 3
