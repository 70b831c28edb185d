"""Depth videos."""

from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pytest
from lerobot.datasets.depth_utils import quantize_depth

from egovcp.data.camera_images import camera_images
from egovcp.data.features import parse_feature
from egovcp.data.lerobot import EpisodeRow, VideoSpan


@pytest.mark.parametrize("use_log", [True, False])
@pytest.mark.parametrize("noise", [0, 5])
def test_holes_of_a_depth_video_are_invalid(noise: int, use_log: bool, tmp_path: Path) -> None:
    """Also if a lossy codec has changed their codes."""
    path, rng = tmp_path / "depth.mkv", np.random.default_rng(0)
    depth = rng.integers(200, 5000, (48, 64)).astype(np.uint16)
    depth[::2] = 0
    codes = quantize_depth(depth, use_log=use_log, video_backend=None)
    codes += rng.integers(0, noise + 1, codes.shape, np.uint16)
    with av.open(str(path), "w") as target:
        stream = target.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "gray12le"
        frame = av.VideoFrame.from_ndarray(codes << 4, format="gray16le").reformat(
            format="gray12le"
        )
        for packet in (*stream.encode(frame), *stream.encode()):
            target.mux(packet)
    info = {"is_depth_map": True, "video.use_log": use_log}
    camera = parse_feature("depth", {"dtype": "video", "shape": [48, 64, 1], "info": info})
    row = EpisodeRow(path, 0, 1, 0, 1, path, {"depth": VideoSpan(path, 0.0)})
    (found,) = camera_images(row, camera, pa.table({}), np.zeros(1))
    assert not found[::2].any()
    np.testing.assert_allclose(found[1::2], depth[1::2] / 1000, atol=0.02)
