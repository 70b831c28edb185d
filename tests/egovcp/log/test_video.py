"""Videos of a rollout show every second tick at the right rate."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from egovcp.log.picture import PictureSink
from egovcp.log.tick import RunInfo
from egovcp.log.video import SIZE, STRIDE, frames


def test_frames_change_with_the_depth_image(make_tick: Any) -> None:
    ticks = [make_tick(i, bare=False) for i in range(2 * STRIDE)]
    first, second = frames(ticks)
    assert first.shape == (SIZE[1], SIZE[0], 3)
    assert (first != second).any()
    assert len(np.unique(first)) > 20


@pytest.mark.parametrize("bare", [False, True])
def test_a_gif_has_one_frame_per_stride(tmp_path: Path, make_tick: Any, bare: bool) -> None:
    path = tmp_path / "a.gif"
    sink = PictureSink(path)
    sink.open(RunInfo("ball"))
    for i in range(6):
        sink.write(make_tick(i, bare=bare))
    sink.close()
    with Image.open(path) as image:
        assert image.size == SIZE
        assert image.info["duration"] == 80
        assert 1 < image.n_frames <= 3  # type: ignore[attr-defined]


def test_an_mp4_has_the_same_frames(tmp_path: Path, make_tick: Any) -> None:
    path = tmp_path / "a.mp4"
    sink = PictureSink(path)
    sink.open(RunInfo("ball"))
    for i in range(6):
        sink.write(make_tick(i, bare=False))
    sink.close()
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == SIZE
        assert float(stream.average_rate or 0) == 12.5
        assert sum(1 for _ in container.decode(video=0)) == 3
