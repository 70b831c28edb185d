"""Draws a rollout as a video, GIF or MP4, without a GPU or a display.

A frame shows the robot in its scene, the depth image, and the image of the same step that the model
imagined `egovcp.log.picture.AHEAD` steps before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.log.meshes import link_meshes
from egovcp.log.picture import AHEAD, draw_depth, draw_robot, imagined_of
from egovcp.log.tick import Tick
from egovcp.packages import require_packages
from egovcp.spec import PLANNER_DT

SIZE: Final = (640, 360)
"""Width and height, pixels; even, as H.264 requires."""
STRIDE: Final = 2
"""Steps between frames: 12.5 frames per second."""
_DPI: Final = 100
_MESH_GRID_M: Final = 0.03

Frame = NDArray[np.uint8]


def write_videos(ticks: Sequence[Tick], paths: Sequence[Path]) -> None:
    """Draw ``ticks`` (in order, without gaps) into each path, a ``.gif`` or ``.mp4``.

    Raises:
        EnvironmentFailure: the package that encodes this format is not installed.
    """
    images = list(frames(ticks))
    for path in paths:
        write = _write_gif if path.suffix == ".gif" else _write_mp4
        write(images, path)


def frames(ticks: Sequence[Tick]) -> Iterator[Frame]:
    """Every `STRIDE`-th tick as an RGB image (H, W, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    meshes = link_meshes(_MESH_GRID_M)
    width, height = SIZE
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    for i in range(0, len(ticks), STRIDE):
        figure.clear()
        draw_robot(figure.add_axes((0.0, 0.0, 0.66, 0.93)), ticks[i], meshes)
        images = {
            "depth image": ticks[i].depth / 1000.0,
            f"imagined {AHEAD * PLANNER_DT:.2f} s before": imagined_of(ticks, i),
        }
        for row, (title, depth_m) in enumerate(images.items()):
            axes = figure.add_axes((0.68, 0.52 - 0.5 * row, 0.3, 0.4))
            draw_depth(axes, depth_m)
            axes.set_title(title, fontsize=8)
        figure.text(0.02, 0.94, f"{ticks[i].index * PLANNER_DT:.2f} s", fontsize=9)
        canvas.draw()  # type: ignore[no-untyped-call]
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def _write_gif(images: Sequence[Frame], path: Path) -> None:
    from PIL import Image

    # One palette, of frames from the whole video: smaller files, and no flicker.
    some = Image.fromarray(np.concatenate(images[:: max(1, len(images) // 8)]))
    palette = some.quantize(128, dither=Image.Dither.NONE)
    first, *others = [
        Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE)
        for image in images
    ]
    milliseconds = round(1000 * STRIDE * PLANNER_DT)
    first.save(path, save_all=True, append_images=others, duration=milliseconds, loop=0)


def _write_mp4(images: Sequence[Frame], path: Path) -> None:
    require_packages("egovcp", "an MP4 video", "av")
    import av

    rate = Fraction(1 / (STRIDE * PLANNER_DT)).limit_denominator(100)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=rate, options={"crf": "23"})
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
