"""A rollout as one picture: a film strip over the curves of value and reward.

Rows: the robot, the depth it saw, what the world model reconstructed, and what it had
imagined of this moment some ticks before; what the run knows nothing of (no world model
played) is left out. No graphics card and no display are needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure
from egovcp.log.info import RunInfo
from egovcp.log.meshes import LinkMesh, link_meshes
from egovcp.log.pose import robot_pose
from egovcp.log.sketch import Eye, paint, paint_floor, paint_skeleton, robot_surface, scene_surface
from egovcp.log.tick import Tick
from egovcp.spec import DEPTH_MAX_M, PLANNER_DT

MOMENTS: Final = 7  # columns of the film strip
AHEAD: Final = 8  # how many ticks before a moment the imagination shown for it was made
_BEFORE_TICKS: Final = 2  # the strip starts this long before the first event
_AFTER_TICKS: Final = 6  # and ends this long after the last one
_MESH_GRID_M: Final = 0.024
_STYLES: Final = {
    "value of the plan": "C0",
    "termination probability": "C3",
    "return so far": "C2",
}
_TOP_INCH: Final = 0.516  # title and times
_ROW_INCH: Final = 1.419  # one row of the film strip
_CURVES_INCH: Final = 2.408  # what lies below the strip


type Films = dict[str, list[NDArray[np.floating] | None]]
type Curves = dict[str, list[float | None]]


class PictureSink:
    """Keeps the ticks of one run and draws them when closed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._title = ""
        self._ticks: list[Tick] = []

    def open(self, info: RunInfo) -> None:
        """Start; nothing is written before `close`."""
        if self._path.exists():
            raise EnvironmentFailure(
                f"{self._path} exists already; recordings are never overwritten: choose another"
            )
        self._title = f"{info.task}, seed {info.seed}, episode {info.episode}"

    def write(self, tick: Tick) -> None:
        """Keep the tick, but of what was imagined only the frame that is shown."""
        film = tick.depth_imagined
        self._ticks.append(replace(tick, candidates=None, depth_imagined=_last_shown(film)))

    def close(self) -> None:
        """Draw the picture of what was written, if anything was."""
        if self._ticks:
            rollout_picture(self._ticks, self._path, self._title)
            self._ticks = []


def _last_shown(film: NDArray[np.floating] | None) -> NDArray[np.floating] | None:
    return None if film is None else film[:AHEAD]


def rollout_picture(ticks: Sequence[Tick], path: Path, title: str = "") -> None:
    """Draw ``ticks`` (in order, without gaps) into the PNG ``path``."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    moments = key_moments(ticks)
    rows = films(ticks, moments)
    height = _TOP_INCH + _ROW_INCH * (1 + len(rows)) + _CURVES_INCH
    figure = Figure(figsize=(2.1 * len(moments) + 0.5, height), facecolor="white")
    FigureCanvasAgg(figure)
    _film_strip(figure, ticks, moments, rows)
    _curves(figure, ticks, moments)
    figure.suptitle(title, fontsize=12, y=1.0 - 0.086 / height)
    figure.savefig(path, dpi=110)


def _place(figure: Any, bottom_inch: float, top_inch: float) -> dict[str, float]:
    """Where in the figure a grid of plots goes, as shares of its size."""
    height = figure.get_figheight()
    return {"left": 0.05, "right": 0.995, "bottom": bottom_inch / height, "top": top_inch / height}


def key_moments(ticks: Sequence[Tick], count: int = MOMENTS) -> list[int]:
    """Indices of up to ``count`` ticks, evenly spread from just before the first event to
    just after the last; over the whole run when nothing happened."""
    last = len(ticks) - 1
    eventful = [i for i, tick in enumerate(ticks) if tick.events]
    begin = max(0, eventful[0] - _BEFORE_TICKS) if eventful else 0
    end = min(last, eventful[-1] + _AFTER_TICKS) if eventful else last
    return sorted({int(i) for i in np.rint(np.linspace(begin, end, count))})


def films(ticks: Sequence[Tick], moments: Sequence[int]) -> Films:
    """The rows of depth pictures; none for what is missing at every moment."""
    rows: Films = {
        "depth seen": [ticks[i].depth / 1000.0 for i in moments],
        "reconstructed": [ticks[i].depth_reconstructed for i in moments],
        f"imagined\n{AHEAD * PLANNER_DT:.2f} s before": [imagined_of(ticks, i) for i in moments],
    }
    return {name: row for name, row in rows.items() if any(depth is not None for depth in row)}


def _film_strip(figure: Any, ticks: Sequence[Tick], moments: Sequence[int], rows: Films) -> None:
    place = _place(figure, _CURVES_INCH, figure.get_figheight() - _TOP_INCH)
    grid = figure.add_gridspec(1 + len(rows), len(moments), hspace=0.04, wspace=0.03, **place)
    first, *others = grid.subplots(squeeze=False)
    meshes = link_meshes(_MESH_GRID_M)
    for axes, i in zip(first, moments, strict=True):
        _robot(axes, ticks[i], meshes)
        axes.set_title(f"{ticks[i].index * PLANNER_DT:.2f} s", fontsize=9)
    for row, (name, film) in zip(others, rows.items(), strict=True):
        row[0].set_ylabel(name, fontsize=9)
        for axes, depth in zip(row, film, strict=True):
            _depth(axes, depth)


def imagined_of(ticks: Sequence[Tick], i: int) -> NDArray[np.floating] | None:
    """What tick i - AHEAD imagined of tick i, (48, 64) m; None where there is nothing."""
    film = ticks[i - AHEAD].depth_imagined if i >= AHEAD else None
    return film[AHEAD - 1] if film is not None and len(film) >= AHEAD else None


def _robot(axes: Any, tick: Tick, meshes: dict[str, LinkMesh]) -> None:
    pose = robot_pose(tick)
    pelvis_w = pose.positions_w[0]
    eye = Eye().following(pelvis_w)
    paint_floor(axes, eye, pelvis_w)
    surfaces = robot_surface(pose, meshes) + scene_surface(tick.scene)
    if not meshes:
        paint_skeleton(axes, pose, eye)
    if surfaces:
        paint(axes, surfaces, eye)
    axes.set(xlim=(-1.0, 1.0), ylim=(-0.75, 0.75), xticks=[], yticks=[], aspect="equal")
    axes.set_frame_on(False)


def _depth(axes: Any, depth_m: NDArray[np.floating] | None) -> None:
    axes.set(xticks=[], yticks=[])
    if depth_m is None:
        axes.set_facecolor("0.95")
        axes.set_box_aspect(48 / 64)
        return
    shown = np.where(np.asarray(depth_m) > 0.0, depth_m, np.nan)
    axes.set_facecolor("0.15")  # shows through where nothing was measured
    axes.imshow(shown, cmap="viridis_r", vmin=0.3, vmax=DEPTH_MAX_M)


def curves(ticks: Sequence[Tick]) -> Curves:
    """What changed over the run; without what no tick knows."""
    known: Curves = {
        "value of the plan": [tick.value for tick in ticks],
        "termination probability": [tick.termination for tick in ticks],
        "return so far": np.cumsum([tick.reward for tick in ticks]).tolist(),
    }
    return {name: row for name, row in known.items() if any(value is not None for value in row)}


def _curves(figure: Any, ticks: Sequence[Tick], moments: Sequence[int]) -> None:
    shown = curves(ticks)
    place = _place(figure, 0.516, 2.021)
    plots = figure.add_gridspec(1, len(shown), wspace=0.13, **place).subplots(squeeze=False)[0]
    for axes, (name, values) in zip(plots, shown.items(), strict=True):
        _curve(axes, ticks, values, _STYLES[name])
        axes.set_title(name, fontsize=9, loc="left")
        for i in moments:
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
    for row, (moment, text) in enumerate(lines):
        axes.axvline(moment, color="0.4", linewidth=0.8, linestyle="--")
        late = moment > 0.6 * time[-1]
        axes.annotate(
            text,
            (moment, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(-3 if late else 3, -2 - 9 * row),
            textcoords="offset points",
            ha="right" if late else "left",
            va="top",
            fontsize=7,
        )
