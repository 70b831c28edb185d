"""Draws a rollout as a PNG and as a video, without a GPU or a display.

The PNG shows key frames above the curves of value and return. Rows: the robot, the depth image, its
reconstruction, and the image of the same step imagined `AHEAD` steps before. Rows without data are
left out. A video frame shows the robot, the depth image and the imagined image.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.log.meshes import link_meshes
from egovcp.log.scene_plot import AXES_OPTIONS, draw_scene
from egovcp.log.tick import RunInfo, Tick, existing_file_error
from egovcp.packages import require_packages
from egovcp.robot_spec import G1, RobotSpec

KEY_FRAMES: Final = 7
AHEAD: Final = 8  # ticks between the imagining of the shown image and its tick
_BEFORE_TICKS: Final = 2  # from the first key frame to the first event
_AFTER_TICKS: Final = 6  # from the last event to the last key frame
_MESH_GRID_M: Final = 0.03
_DPI: Final = 100  # of a video
SIZE: Final = (640, 360)
"""Width and height of a video, pixels; even, as H.264 requires."""
STRIDE: Final = 2
"""Steps between frames of a video."""
_COLOURS: Final = {
    "value of the plan": "C0",
    "termination probability": "C3",
    "return so far": "C2",
}
_TOP_INCH: Final = 0.516  # title and times
_ROW_INCH: Final = 1.419  # a row of images
_CURVES_INCH: Final = 2.408  # the curves


type Frame = NDArray[np.uint8]
type DepthRows = dict[str, list[NDArray[np.floating] | None]]
type Curves = dict[str, list[float | None]]
type ImaginedImages = Mapping[int, NDArray[np.floating]]
"""`Tick.index` -> its depth image (H, W) in m, as imagined `AHEAD` ticks before."""


class RolloutVideoSink:
    """Collects the ticks of a run and draws them on `close`, as a PNG or a video.

    Memory and the time of `close` grow with the run, so live runs of a robot have none.
    """

    def __init__(self, *paths: Path) -> None:
        """``paths``: ``.png`` for key frames, ``.gif`` or ``.mp4`` for a video."""
        self._paths = paths
        self._title = ""
        self._robot = G1
        self._ticks: list[Tick] = []
        self._imagined: dict[int, NDArray[np.floating]] = {}  # see `ImaginedImages`

    def open(self, info: RunInfo) -> None:
        """Check that the files do not exist."""
        for path in self._paths:
            if path.exists():
                raise existing_file_error(path)
        self._robot = info.robot
        self._title = f"{info.task}, seed {info.seed}, episode {info.episode}"

    def write(self, tick: Tick) -> None:
        """Keep what is drawn of the tick: of its imagined images, that of `AHEAD` ticks later."""
        images = tick.depth_imagined
        if images is not None and len(images) >= AHEAD:
            self._imagined[tick.index + AHEAD] = images[AHEAD - 1].copy()
        self._ticks.append(
            replace(tick, depth_imagined=None, plan=None, candidates=None, value_maps=())
        )

    def close(self) -> None:
        """Draw the files, if there are ticks."""
        ticks, self._ticks = self._ticks, []
        imagined, self._imagined = self._imagined, {}
        if not ticks:
            return
        videos = [path for path in self._paths if path.suffix != ".png"]
        for path in set(self._paths).difference(videos):
            write_key_frames(ticks, imagined, path, self._title, self._robot)
        if videos:
            write_videos(ticks, imagined, videos, self._robot)


def write_key_frames(
    ticks: Sequence[Tick], imagined: ImaginedImages, path: Path, title: str, robot: RobotSpec
) -> None:
    """Draw ``ticks``, in order, into the PNG ``path``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    frames = key_frames(ticks)
    rows = depth_rows([ticks[i] for i in frames], imagined, robot)
    height = _TOP_INCH + _ROW_INCH * (1 + len(rows)) + _CURVES_INCH
    figure = Figure(figsize=(2.1 * len(frames) + 0.5, height), facecolor="white")
    FigureCanvasAgg(figure)
    _draw_images(figure, ticks, frames, rows, robot)
    _curves(figure, ticks, frames, 1.0 / robot.planner_hz)
    figure.suptitle(title, fontsize=12, y=1.0 - 0.086 / height)
    figure.savefig(path, dpi=110)


def _place(figure: Any, bottom_inch: float, top_inch: float) -> dict[str, float]:
    """Position of a grid of plots as fractions of the figure."""
    height = figure.get_figheight()
    return {"left": 0.05, "right": 0.995, "bottom": bottom_inch / height, "top": top_inch / height}


def key_frames(ticks: Sequence[Tick]) -> list[int]:
    """Indices of up to `KEY_FRAMES` ticks, evenly spaced from just before the first event to just
    after the last, or over the whole run without events."""
    last = len(ticks) - 1
    eventful = [i for i, tick in enumerate(ticks) if tick.events]
    begin = max(0, eventful[0] - _BEFORE_TICKS) if eventful else 0
    end = min(last, eventful[-1] + _AFTER_TICKS) if eventful else last
    return sorted({int(i) for i in np.rint(np.linspace(begin, end, KEY_FRAMES))})


def depth_rows(ticks: Sequence[Tick], imagined: ImaginedImages, robot: RobotSpec) -> DepthRows:
    """The rows of depth images of the ``ticks``; a row without any image is left out."""
    before = f"imagined\n{AHEAD / robot.planner_hz:.2f} s before"
    rows: DepthRows = {
        "depth seen": [tick.depth / 1000.0 for tick in ticks],
        "reconstructed": [tick.depth_reconstructed for tick in ticks],
        before: [imagined.get(tick.index) for tick in ticks],
    }
    return {name: row for name, row in rows.items() if any(depth is not None for depth in row)}


def _draw_images(
    figure: Any, ticks: Sequence[Tick], frames: Sequence[int], rows: DepthRows, robot: RobotSpec
) -> None:
    place = _place(figure, _CURVES_INCH, figure.get_figheight() - _TOP_INCH)
    grid = figure.add_gridspec(1 + len(rows), len(frames), hspace=0.04, wspace=0.03, **place)
    meshes = link_meshes(_MESH_GRID_M)
    for column, i in enumerate(frames):
        axes = figure.add_subplot(grid[0, column], **AXES_OPTIONS)
        draw_scene(axes, ticks[i], meshes, robot)
        axes.set_title(f"{ticks[i].index / robot.planner_hz:.2f} s", fontsize=9)
        for row, (name, images) in enumerate(rows.items(), start=1):
            axes = figure.add_subplot(grid[row, column])
            draw_depth(axes, images[column], robot)
            if column == 0:
                axes.set_ylabel(name, fontsize=9)


def draw_depth(axes: Any, depth_m: NDArray[np.floating] | None, robot: RobotSpec) -> None:
    """Draw a depth image (H, W) in m; None: an empty field."""
    axes.set(xticks=[], yticks=[])
    if depth_m is None:
        axes.set_facecolor("0.95")
        axes.set_box_aspect(robot.depth[0] / robot.depth[1])
        return
    shown = np.where(np.asarray(depth_m) > 0.0, depth_m, np.nan)
    axes.set_facecolor("0.15")  # colour of invalid pixels
    axes.imshow(shown, cmap="viridis_r", vmin=0.06 * robot.depth_max_m, vmax=robot.depth_max_m)


def grey_image(depth_m: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Depth (H, W) in m of the G1 as an image (4 H, 4 W, 3): near is bright, invalid black.

    Video encoders need more than 64 columns.
    """
    near = np.where(depth_m == 0, 0.0, 255.0 * (1.0 - depth_m / G1.depth_max_m))
    grey = near.clip(0, 255).astype(np.uint8).repeat(4, 0).repeat(4, 1)
    return np.stack([grey] * 3, -1)


def curves(ticks: Sequence[Tick]) -> Curves:
    """Curve name -> value per tick; curves without any value are left out."""
    known: Curves = {
        "value of the plan": [tick.value for tick in ticks],
        "termination probability": [tick.termination for tick in ticks],
        "return so far": np.cumsum([tick.reward for tick in ticks]).tolist(),
    }
    return {name: row for name, row in known.items() if any(value is not None for value in row)}


def _curves(figure: Any, ticks: Sequence[Tick], frames: Sequence[int], dt: float) -> None:
    shown = curves(ticks)
    place = _place(figure, 0.516, 2.021)
    plots = figure.add_gridspec(1, len(shown), wspace=0.13, **place).subplots(squeeze=False)[0]
    time = [tick.index * dt for tick in ticks]
    for axes, (name, values) in zip(plots, shown.items(), strict=True):
        axes.plot(time, np.array(values, np.float64), color=_COLOURS[name])
        axes.margins(x=0.01, y=0.25)
        axes.set_title(name, fontsize=9, loc="left")
        axes.set_xlabel("s", fontsize=9, labelpad=0)
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
        _mark_events(axes, ticks, time)
        for i in frames:
            axes.axvline(time[i], color="0.9", linewidth=1, zorder=0)


def _mark_events(axes: Any, ticks: Sequence[Tick], time: list[float]) -> None:
    """A dashed line and its text per event, one below the other at the top of the plot."""
    lines = [(t, text) for t, tick in zip(time, ticks, strict=True) for text in tick.events]
    for row, (time_s, text) in enumerate(lines):
        axes.axvline(time_s, color="0.4", linewidth=0.8, linestyle="--")
        late = time_s > 0.6 * time[-1]
        axes.annotate(
            text,
            (time_s, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(-3 if late else 3, -2 - 9 * row),
            textcoords="offset points",
            ha="right" if late else "left",
            va="top",
            fontsize=7,
        )


def write_videos(
    ticks: Sequence[Tick], imagined: ImaginedImages, paths: Sequence[Path], robot: RobotSpec
) -> None:
    """Draw ``ticks`` (in order, without gaps) into each path, a ``.gif`` or ``.mp4``.

    Raises:
        EnvironmentFailure: the package that encodes this format is not installed.
    """
    images, dt = list(video_frames(ticks, imagined, robot)), 1.0 / robot.planner_hz
    for path in paths:
        write = _write_gif if path.suffix == ".gif" else _write_mp4
        write(images, path, dt)


def video_frames(
    ticks: Sequence[Tick], imagined: ImaginedImages, robot: RobotSpec
) -> Iterator[Frame]:
    """Every `STRIDE`-th tick as an RGB image (H, W, 3)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    meshes = link_meshes(_MESH_GRID_M)
    width, height = SIZE
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    titles = ["depth image", f"imagined {AHEAD / robot.planner_hz:.2f} s before"]
    if not any(tick.depth.any() for tick in ticks):  # no camera
        titles = []
    left = 0.0 if titles else 0.17
    scene = figure.add_axes((left, 0.0, 0.66, 0.93), **AXES_OPTIONS)
    images = [figure.add_axes((0.68, 0.52 - 0.5 * row, 0.3, 0.4)) for row in range(len(titles))]
    for axes, title in zip(images, titles, strict=True):
        axes.set_title(title, fontsize=8)
    clock = figure.text(0.02, 0.94, "", fontsize=9)
    for i in range(0, len(ticks), STRIDE):
        # Axes are slow to make: only what they show is replaced.
        for artist in (*scene.collections, *(image for axes in images for image in axes.images)):
            artist.remove()
        draw_scene(scene, ticks[i], meshes, robot)
        shown = (ticks[i].depth / 1000.0, imagined.get(ticks[i].index))
        for axes, depth in zip(images, shown, strict=False):
            draw_depth(axes, depth, robot)
        clock.set_text(f"{ticks[i].index / robot.planner_hz:.2f} s")
        canvas.draw()  # type: ignore[no-untyped-call]
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def _write_gif(images: Sequence[Frame], path: Path, dt: float) -> None:
    from PIL import Image

    # One palette, of frames from the whole video: smaller files, and no flicker.
    some = Image.fromarray(np.concatenate(images[:: max(1, len(images) // 8)]))
    palette = some.quantize(128, dither=Image.Dither.NONE)
    first, *others = [
        Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE)
        for image in images
    ]
    # A GIF counts in steps of 10 ms: rounding the ends of the frames keeps the speed.
    ends = 10 * np.rint(100 * STRIDE * dt * np.arange(len(images) + 1)).astype(int)
    durations = np.diff(ends).tolist()
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0)


def _write_mp4(images: Sequence[Frame], path: Path, dt: float) -> None:
    require_packages("egovcp", "an MP4 video", "av")
    import av

    rate = Fraction(1 / (STRIDE * dt)).limit_denominator(100)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=rate, options={"crf": "23"})
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
