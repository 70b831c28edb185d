"""Draws a rollout as one PNG: key frames above the curves of value and return.

Rows: the robot, the depth image, its reconstruction, and the image of the same tick imagined
`AHEAD` ticks before. Rows without data are left out. Needs neither a GPU nor a display.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure
from egovcp.log.meshes import LinkMesh, link_meshes
from egovcp.log.pose import robot_pose
from egovcp.log.sketch import (
    Viewpoint,
    paint,
    paint_floor,
    paint_skeleton,
    robot_surface,
    scene_surface,
)
from egovcp.log.tick import RunInfo, Tick
from egovcp.spec import DEPTH_MAX_M, PLANNER_DT

KEY_FRAMES: Final = 7
AHEAD: Final = 8  # ticks between the imagining of the shown image and its tick
_BEFORE_TICKS: Final = 2  # from the first key frame to the first event
_AFTER_TICKS: Final = 6  # from the last event to the last key frame
_MESH_GRID_M: Final = 0.024
_STYLES: Final = {
    "value of the plan": "C0",
    "termination probability": "C3",
    "return so far": "C2",
}
_TOP_INCH: Final = 0.516  # title and times
_ROW_INCH: Final = 1.419  # a row of images
_CURVES_INCH: Final = 2.408  # the curves


type DepthRows = dict[str, list[NDArray[np.floating] | None]]
type Curves = dict[str, list[float | None]]


class PictureSink:
    """Collects the ticks of a run and draws them on `close`, as a picture or a video."""

    def __init__(self, *paths: Path) -> None:
        """Choose the files.

        Args:
            paths: ``.png`` for key frames, ``.gif`` or ``.mp4`` for a video.
        """
        self._paths = paths
        self._title = ""
        self._ticks: list[Tick] = []

    def open(self, info: RunInfo) -> None:
        """Check that the files do not exist."""
        for path in self._paths:
            if path.exists():
                raise EnvironmentFailure(
                    f"{path} exists already; recordings are never overwritten: choose another"
                )
        self._title = f"{info.task}, seed {info.seed}, episode {info.episode}"

    def write(self, tick: Tick) -> None:
        """Keep the tick without candidates and later imagined images."""
        images = tick.depth_imagined
        shown = None if images is None else images[:AHEAD]
        self._ticks.append(replace(tick, candidates=None, depth_imagined=shown))

    def close(self) -> None:
        """Draw the files, if there are ticks."""
        ticks, self._ticks = self._ticks, []
        if not ticks:
            return
        videos = [path for path in self._paths if path.suffix != ".png"]
        for path in set(self._paths).difference(videos):
            rollout_picture(ticks, path, self._title)
        if videos:
            from egovcp.log.video import write_videos

            write_videos(ticks, videos)


def rollout_picture(ticks: Sequence[Tick], path: Path, title: str = "") -> None:
    """Draw ``ticks`` (in order, without gaps) into the PNG ``path``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    frames = key_frames(ticks)
    rows = depth_rows(ticks, frames)
    height = _TOP_INCH + _ROW_INCH * (1 + len(rows)) + _CURVES_INCH
    figure = Figure(figsize=(2.1 * len(frames) + 0.5, height), facecolor="white")
    FigureCanvasAgg(figure)
    _draw_images(figure, ticks, frames, rows)
    _curves(figure, ticks, frames)
    figure.suptitle(title, fontsize=12, y=1.0 - 0.086 / height)
    figure.savefig(path, dpi=110)


def _place(figure: Any, bottom_inch: float, top_inch: float) -> dict[str, float]:
    """Position of a grid of plots as fractions of the figure."""
    height = figure.get_figheight()
    return {"left": 0.05, "right": 0.995, "bottom": bottom_inch / height, "top": top_inch / height}


def key_frames(ticks: Sequence[Tick], count: int = KEY_FRAMES) -> list[int]:
    """Indices of up to ``count`` ticks, evenly spaced from just before the first event to just
    after the last, or over the whole run without events."""
    last = len(ticks) - 1
    eventful = [i for i, tick in enumerate(ticks) if tick.events]
    begin = max(0, eventful[0] - _BEFORE_TICKS) if eventful else 0
    end = min(last, eventful[-1] + _AFTER_TICKS) if eventful else last
    return sorted({int(i) for i in np.rint(np.linspace(begin, end, count))})


def depth_rows(ticks: Sequence[Tick], frames: Sequence[int]) -> DepthRows:
    """The rows of depth images; a row without any image is left out."""
    rows: DepthRows = {
        "depth seen": [ticks[i].depth / 1000.0 for i in frames],
        "reconstructed": [ticks[i].depth_reconstructed for i in frames],
        f"imagined\n{AHEAD * PLANNER_DT:.2f} s before": [imagined_of(ticks, i) for i in frames],
    }
    return {name: row for name, row in rows.items() if any(depth is not None for depth in row)}


def _draw_images(
    figure: Any, ticks: Sequence[Tick], frames: Sequence[int], rows: DepthRows
) -> None:
    place = _place(figure, _CURVES_INCH, figure.get_figheight() - _TOP_INCH)
    grid = figure.add_gridspec(1 + len(rows), len(frames), hspace=0.04, wspace=0.03, **place)
    first, *others = grid.subplots(squeeze=False)
    meshes = link_meshes(_MESH_GRID_M)
    for axes, i in zip(first, frames, strict=True):
        draw_robot(axes, ticks[i], meshes)
        axes.set_title(f"{ticks[i].index * PLANNER_DT:.2f} s", fontsize=9)
    for row, (name, images) in zip(others, rows.items(), strict=True):
        row[0].set_ylabel(name, fontsize=9)
        for axes, depth in zip(row, images, strict=True):
            draw_depth(axes, depth)


def imagined_of(ticks: Sequence[Tick], i: int) -> NDArray[np.floating] | None:
    """The image of tick i imagined at tick i - AHEAD, (48, 64) m; None: there is none."""
    images = ticks[i - AHEAD].depth_imagined if i >= AHEAD else None
    return images[AHEAD - 1] if images is not None and len(images) >= AHEAD else None


def draw_robot(axes: Any, tick: Tick, meshes: dict[str, LinkMesh]) -> None:
    """Draw robot and scene of a tick; without meshes the robot is a skeleton."""
    pose = robot_pose(tick)
    pelvis_w = pose.positions_w[0]
    view = Viewpoint().following(pelvis_w)
    paint_floor(axes, view, pelvis_w)
    surfaces = robot_surface(pose, meshes) + scene_surface(tick.scene)
    if not meshes:
        paint_skeleton(axes, pose, view)
    if surfaces:
        paint(axes, surfaces, view)
    axes.set(xlim=(-1.0, 1.0), ylim=(-0.75, 0.75), xticks=[], yticks=[], aspect="equal")
    axes.set_frame_on(False)


def draw_depth(axes: Any, depth_m: NDArray[np.floating] | None) -> None:
    """Draw a depth image (48, 64) in m; None: an empty field."""
    axes.set(xticks=[], yticks=[])
    if depth_m is None:
        axes.set_facecolor("0.95")
        axes.set_box_aspect(48 / 64)
        return
    shown = np.where(np.asarray(depth_m) > 0.0, depth_m, np.nan)
    axes.set_facecolor("0.15")  # colour of invalid pixels
    axes.imshow(shown, cmap="viridis_r", vmin=0.3, vmax=DEPTH_MAX_M)


def curves(ticks: Sequence[Tick]) -> Curves:
    """Curve name -> value per tick; curves without any value are left out."""
    known: Curves = {
        "value of the plan": [tick.value for tick in ticks],
        "termination probability": [tick.termination for tick in ticks],
        "return so far": np.cumsum([tick.reward for tick in ticks]).tolist(),
    }
    return {name: row for name, row in known.items() if any(value is not None for value in row)}


def _curves(figure: Any, ticks: Sequence[Tick], frames: Sequence[int]) -> None:
    shown = curves(ticks)
    place = _place(figure, 0.516, 2.021)
    plots = figure.add_gridspec(1, len(shown), wspace=0.13, **place).subplots(squeeze=False)[0]
    for axes, (name, values) in zip(plots, shown.items(), strict=True):
        _curve(axes, ticks, values, _STYLES[name])
        axes.set_title(name, fontsize=9, loc="left")
        for i in frames:
            axes.axvline(ticks[i].index * PLANNER_DT, color="0.9", linewidth=1, zorder=0)


def _curve(axes: Any, ticks: Sequence[Tick], values: list[float | None], style: str) -> None:
    time = [tick.index * PLANNER_DT for tick in ticks]
    axes.plot(time, [np.nan if value is None else value for value in values], color=style)
    axes.margins(x=0.01, y=0.25)
    _mark_events(axes, ticks, time)
    axes.set_xlabel("s", fontsize=9, labelpad=0)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)


def _mark_events(axes: Any, ticks: Sequence[Tick], time: list[float]) -> None:
    """A dashed line and its text per event, one below the other at the top of the plot."""
    eventful = [(t, tick.events) for t, tick in zip(time, ticks, strict=True) if tick.events]
    lines = [(t, text) for t, events in eventful for text in events]
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
