"""Plots of a dataset's statistics: events, returns, actions, depth."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.data import ReturnConfig
from egovcp.packages import require_packages
from egovcp.spec import ACTION_BOX, ACTION_NAMES, ACTION_TERMS, DEPTH_MAX_M, PLANNER_DT
from egovcp_collect.dataset.statistics import (
    HISTOGRAM_BINS,
    DatasetStatistics,
    TaskStatistics,
    TermRate,
    events_ahead,
)
from egovcp_collect.dataset.task_data import SHOWN_FRAMES, DepthFrames, TaskRows

_SUCCESS, _FAILURE, _NEUTRAL = "#1b7837", "#c0392b", "#8a8f98"
_COLOURS: Final = ("#d95f02", "#7570b3", "#1b9e77", "#e7298a", "#66a61e", "#e6ab02")  # per task
_AROUND_EVENT: Final = (-20, 160)  # ticks
_GAP_PIXELS: Final = 2  # between depth images
_MAX_DENSITY_ROWS: Final = 200_000
_MAX_PALMS: Final = 1500


def require_matplotlib() -> None:
    """Raise `MissingPackage` if matplotlib is not installed."""
    require_packages("egovcp-collect", "a plot", "matplotlib")


def draw_figures(statistics: DatasetStatistics, returns: ReturnConfig, folder: Path) -> list[Path]:
    """Write ``events.png``, ``returns.png``, ``actions.png`` and ``depth.png``; return the paths.

    Call `require_matplotlib` before.
    """
    folder.mkdir(parents=True, exist_ok=True)
    figures = {
        "events.png": _events(statistics.tasks),
        "returns.png": _returns(statistics.rows, returns),
        "actions.png": _actions(statistics),
        "depth.png": _depth(statistics),
    }
    for name, figure in figures.items():
        options = {"metadata": {"Software": None}, "pil_kwargs": {"optimize": True}}
        figure.savefig(folder / name, dpi=100, **options)
    return [folder / name for name in figures]


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure  # draws without a display, unlike pyplot

    return Figure(figsize=(width, height), facecolor="white", layout="constrained")


def _label(axes: Any, x: str = "", y: str = "", title: str = "", legend: bool = False) -> None:
    axes.set_xlabel(x, fontsize=9)
    axes.set_ylabel(y, fontsize=9)
    axes.set_title(title, fontsize=10)
    if legend:
        axes.legend(fontsize=8, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def _events(tasks: Sequence[TaskStatistics]) -> Any:
    """Bars of the rate of each reward term and contact, one panel per task."""
    bars = max(len(task.term_rates) for task in tasks)
    figure = _figure(4.2 * max(len(tasks), 2), 0.9 + 0.32 * bars)
    for axes, task in zip(figure.subplots(1, len(tasks), squeeze=False)[0], tasks, strict=True):
        names = list(task.term_rates)
        rates = [task.term_rates[name].per_1000_ticks for name in names]
        colours = [_event_colour(name, task.term_rates[name]) for name in names]
        axes.barh(range(len(names)), rates, color=colours, height=0.7)
        axes.set_yticks(range(len(names)), names)
        axes.invert_yaxis()
        axes.set_xscale("symlog", linthresh=0.1)
        axes.set_xlim(0, 2e5)  # space for the text right of the longest bar
        axes.set_xticks([0, 0.1, 1, 10, 100, 1000], ["0", "0.1", "1", "10", "100", "1000"])
        axes.minorticks_off()
        for i, (name, rate) in enumerate(zip(names, rates, strict=True)):
            term = task.term_rates[name]
            number = f"{rate:.0f}" if rate >= 100 else f"{rate:.2f}"
            text = f" {number}, in {term.episode_share:.0%} of episodes"
            axes.text(rate, i, text if term.ticks else " never", va="center", fontsize=8)
        title = f"{task.task}: {task.episodes} episodes, {task.frames} frames"
        _label(axes, "per 1000 ticks", title=title)
    return figure


def _event_colour(name: str, rate: TermRate) -> str:
    """Colour of a reward term by its sign; costs of actions and contacts of the hands are neutral,
    other contacts failures."""
    if name in ACTION_TERMS:
        return _NEUTRAL
    if name == "touch.other" or rate.sum < 0:
        return _FAILURE
    return _SUCCESS if rate.sum > 0 else _NEUTRAL


def _returns(tasks: Sequence[TaskRows], config: ReturnConfig) -> Any:
    """Per task: histograms of the return by the events ahead; the return around the event."""
    figure = _figure(4.8 * max(len(tasks), 2), 6.0)
    columns = figure.subplots(2, len(tasks), squeeze=False).T
    for (above, below), rows, colour in zip(columns, tasks, cycle(_COLOURS)):
        title = f"{rows.task}: return over {config.steps} ticks"
        if rows.mc_valid.any():
            _return_histogram(above, rows, config)
            _return_around_event(below, rows, colour)
        above.set_title(title, fontsize=10)
    return figure


def _return_histogram(axes: Any, rows: TaskRows, config: ReturnConfig) -> None:
    success, failure = events_ahead(rows, config.steps)
    kinds = {
        "a failure event ahead": failure,
        "only success events ahead": success & ~failure,
        "no event ahead": ~success & ~failure,
    }
    valid = rows.mc_valid
    edges = np.histogram_bin_edges(rows.mc_return[valid], 60)
    for (name, kind), colour in zip(kinds.items(), (_FAILURE, _SUCCESS, _NEUTRAL), strict=True):
        label = f"{name} ({kind[valid].mean():.0%})"
        counts, _ = np.histogram(rows.mc_return[valid & kind], edges)
        axes.stairs(counts, edges, fill=True, alpha=0.55, color=colour, label=label)
    axes.set_yscale("symlog", linthresh=10)  # shows 0, too
    axes.set_ylim(0, None)
    _label(axes, "Monte Carlo return", "frames", legend=True)


def _return_around_event(axes: Any, rows: TaskRows, colour: str) -> None:
    """Mean, median and 5 to 95 % of the return over the time since the event."""
    events = np.array([metadata.get("event_tick") for metadata in rows.metadata], np.float64)
    since = np.arange(len(rows.reward)) - np.repeat(rows.start + events, rows.length)  # NaN: none
    values = {t: rows.mc_return[(since == t) & rows.mc_valid] for t in range(*_AROUND_EVENT)}
    values = {t: returns for t, returns in values.items() if len(returns) >= 5}
    if values:
        low, median, high = np.array([np.quantile(v, (0.05, 0.5, 0.95)) for v in values.values()]).T
        time = np.array([*values]) * PLANNER_DT
        axes.fill_between(time, low, high, color=colour, alpha=0.2, lw=0, label="5 to 95 %")
        axes.plot(time, median, color=colour, lw=1, ls="--", label="median")
        means = [v.mean() for v in values.values()]
        axes.plot(time, means, color=colour, lw=2, label="mean")
        axes.axvline(0.0, color="0.6", lw=0.8)
    _label(axes, "s since the event", "return", legend=bool(values))


def _actions(statistics: DatasetStatistics) -> Any:
    """A histogram per action; below, densities of hand targets and palms from two sides."""
    figure = _figure(12.6, 5.6)
    top, bottom = figure.subfigures(2, 1, height_ratios=[1.0, 1.5])
    edges = np.linspace(-1.0, 1.0, HISTOGRAM_BINS + 1)
    panels = top.subplots(1, len(ACTION_NAMES), sharey=True)
    for axes, name in zip(panels, ACTION_NAMES, strict=True):
        for task, colour in zip(statistics.tasks, cycle(_COLOURS)):
            counts = np.array(task.action.histogram[name])
            density = counts / counts.sum() * HISTOGRAM_BINS
            axes.stairs(density, edges, color=colour, lw=1.4, label=task.task)
        axes.axhline(1.0, color="0.7", lw=0.8, zorder=0)
        axes.set(xlim=(-1, 1), xticks=[-1, 0, 1])
        _label(axes, title=name.replace("_", " "))
    panels[0].set_ylim(0, None)  # shared by all panels
    panels[0].set_ylabel("density (uniform: 1)", fontsize=9)
    if len(statistics.tasks) > 1:
        panels[-1].legend(fontsize=7, frameon=False, loc="lower center")
    _hand_densities(bottom, statistics)
    return figure


def _hand_densities(figure: Any, statistics: DatasetStatistics) -> None:
    action = np.concatenate([rows.action for rows in statistics.rows])
    targets = ACTION_BOX.to_metric(action[:: 1 + len(action) // _MAX_DENSITY_ROWS])
    palms = np.concatenate([sample.palms_b for sample in statistics.samples])
    palms = palms[:: 1 + len(palms) // _MAX_PALMS]
    views = [(hand, axis) for axis in (0, 1) for hand in (0, 1)]
    for axes, (hand, axis) in zip(figure.subplots(1, 4), views, strict=True):
        across, up = 3 * hand + axis, 3 * hand + 2
        edges = [np.linspace(ACTION_BOX.low[i], ACTION_BOX.high[i], 25) for i in (across, up)]
        counts, *_ = np.histogram2d(targets[:, across], targets[:, up], bins=edges)
        # Below the neutral pose the box is short, so uniform actions are dense there; the square
        # root keeps the rest visible.
        axes.pcolormesh(*edges, np.sqrt(counts.T), cmap="Greys", vmin=0)
        axes.plot(palms[:, hand, axis], palms[:, hand, 2], ".", ms=1.2, color="#e8710a", alpha=0.5)
        axes.set_aspect("equal")
        side = "from the side" if axis == 0 else "from behind"
        title = f"{('left', 'right')[hand]} hand, {side}"
        _label(axes, f"{'xyz'[axis]} (m)", "z (m)", title)
        if axis == 1:
            axes.invert_xaxis()  # y points left
    figure.supxlabel(
        "grey: hand targets, m in the pelvis heading frame (darker: more often); "
        "orange: measured palm positions",
        fontsize=9,
    )


def _depth(statistics: DatasetStatistics) -> Any:
    """Depth images of example episodes, one row per episode."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    shown = [
        (rows.task, frames)
        for rows, sample in zip(statistics.rows, statistics.samples, strict=True)
        for frames in sample.shown
    ]
    colours = colormaps["viridis_r"].with_extremes(bad="0.8")
    mapping = ScalarMappable(Normalize(0.0, DEPTH_MAX_M), colours)
    figure = _figure(1.5 * SHOWN_FRAMES + 1.0, 1.4 * len(shown) + 0.3)
    grid = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for axes, (task, frames) in zip(grid, shown, strict=True):
        _depth_row(axes, frames, mapping)
        axes.set_ylabel(f"{task}\nepisode {frames.episode}", fontsize=9)
    bar = figure.colorbar(mapping, ax=grid, fraction=0.02, pad=0.01)
    bar.set_label("depth (m); grey: not measured", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return figure


def _depth_row(axes: Any, frames: DepthFrames, mapping: Any) -> None:
    """Draw the images as one, which is faster than one subplot for each."""
    rows, cols = frames.depth.shape[1:]
    pitch = cols + _GAP_PIXELS
    image = np.full((rows, SHOWN_FRAMES * pitch - _GAP_PIXELS, 4), 255, np.uint8)
    for i, depth in enumerate(frames.depth):
        metres: NDArray[np.float64] = np.where(depth > 0, depth / 1000.0, np.nan)
        image[:, i * pitch : i * pitch + cols] = mapping.cmap(mapping.norm(metres), bytes=True)
    axes.imshow(image)
    axes.xaxis.tick_top()
    middles = [i * pitch + cols / 2 for i in range(len(frames.tick))]
    axes.set_xticks(middles, [f"{tick * PLANNER_DT:.2f} s" for tick in frames.tick], fontsize=8)
    axes.tick_params(length=0, pad=1)
    axes.set_yticks([])
    axes.spines[:].set_visible(False)
