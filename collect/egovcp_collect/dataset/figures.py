"""Pictures of a dataset's coverage: events, returns, actions, depth.

matplotlib draws them without a display; it is imported only when a picture is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.data import ReturnConfig
from egovcp.packages import require_packages
from egovcp.spec import ACTION_BOX, ACTION_NAMES, DEPTH_MAX_M, PLANNER_DT
from egovcp_collect.dataset.occupancy import BINS
from egovcp_collect.dataset.rows import TaskRows
from egovcp_collect.dataset.sample import FRAMES, FilmStrip
from egovcp_collect.dataset.survey import BAD_TERMS, GOOD_TERMS, Survey, TaskSurvey, events_ahead

_DPI: Final = 100
_GOOD, _BAD, _PLAIN = "#1b7837", "#c0392b", "#8a8f98"
_COLOURS: Final = {"ball": "#d95f02", "wall": "#7570b3", "arch": "#1b9e77"}
_AROUND: Final = (-20, 160)  # ticks around the event that the returns are shown over
_GAP: Final = 2  # pixels between the frames of a film strip
_DENSITY_ROWS: Final = 200_000  # of the actions that densities are drawn from


def require_matplotlib() -> None:
    """Raise `MissingPackage` where there is no matplotlib."""
    require_packages("egovcp-collect", "a picture", "matplotlib")


def draw_figures(found: Survey, returns: ReturnConfig, folder: Path) -> list[Path]:
    """Draw ``events.png``, ``returns.png``, ``actions.png`` and ``depth.png``; return the paths.

    Raises:
        EnvironmentFailure: matplotlib is not installed.
    """
    require_matplotlib()
    folder.mkdir(parents=True, exist_ok=True)
    figures = {
        "events.png": _events(found.tasks),
        "returns.png": _returns(found.rows, returns),
        "actions.png": _actions(found),
        "depth.png": _depth(found),
    }
    for name, figure in figures.items():
        figure.savefig(
            folder / name, dpi=_DPI, metadata={"Software": None}, pil_kwargs={"optimize": True}
        )
    return [folder / name for name in figures]


def _figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _plain(axes: Any) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def _events(tasks: Sequence[TaskSurvey]) -> Any:
    """Bars of ticks per 1000 steps, one panel per task."""
    rows = max(len(task.events) for task in tasks)
    figure = _figure(4.2 * max(len(tasks), 2), 0.9 + 0.32 * rows)
    for axes, task in zip(figure.subplots(1, len(tasks), squeeze=False)[0], tasks, strict=True):
        _event_bars(axes, task)
    return figure


def _event_bars(axes: Any, task: TaskSurvey) -> None:
    good, bad = GOOD_TERMS[task.task], (*BAD_TERMS[task.task], "touch.other")
    names = list(task.events)
    rates = [task.events[name].per_1000_steps for name in names]
    colours = [_GOOD if n in good else _BAD if n in bad else _PLAIN for n in names]
    axes.barh(range(len(names)), rates, color=colours, height=0.7)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xscale("symlog", linthresh=0.1)
    axes.set_xlim(0, 2e5)  # room for the text behind the longest bar
    axes.set_xticks([0, 0.1, 1, 10, 100, 1000], ["0", "0.1", "1", "10", "100", "1000"])
    axes.minorticks_off()
    for i, name in enumerate(names):
        rate = task.events[name]
        digits = f"{rate.per_1000_steps:.{0 if rate.per_1000_steps >= 100 else 2}f}"
        text = f" {digits}, in {rate.episode_share:.0%} of episodes" if rate.ticks else " never"
        axes.text(rates[i], i, text, va="center", fontsize=8)
    axes.set_title(f"{task.task}: {task.episodes} episodes, {task.steps} steps", fontsize=10)
    axes.set_xlabel("ticks per 1000 steps", fontsize=9)
    _plain(axes)


def _returns(tasks: Sequence[TaskRows], config: ReturnConfig) -> Any:
    """Per task: the returns by what lies ahead, and how they run around the event."""
    figure = _figure(4.8 * max(len(tasks), 2), 6.0)
    for (above, below), rows in zip(
        figure.subplots(2, len(tasks), squeeze=False).T, tasks, strict=True
    ):
        above.set_title(f"{rows.task}: return over {config.steps} ticks", fontsize=10)
        if rows.mc_valid.any():
            _return_histogram(above, rows, config)
            _return_around_event(below, rows)
    return figure


def _return_histogram(axes: Any, rows: TaskRows, config: ReturnConfig) -> None:
    good, bad = events_ahead(rows, config.steps)
    kinds = {"a cost ahead": bad, "a reward, no cost ahead": good & ~bad, "neither": ~good & ~bad}
    valid = rows.mc_valid
    edges = np.histogram_bin_edges(rows.mc_return[valid], 60)
    for (name, kind), colour in zip(kinds.items(), (_BAD, _GOOD, _PLAIN), strict=True):
        label = f"{name} ({kind[valid].mean():.0%})"
        counts, _ = np.histogram(rows.mc_return[valid & kind], edges)
        axes.stairs(counts, edges, fill=True, alpha=0.55, color=colour, label=label)
    axes.set_yscale("symlog", linthresh=10)  # none at all is a count, too
    axes.set_ylim(0, None)
    axes.set_xlabel("Monte Carlo return", fontsize=9)
    axes.set_ylabel("rows", fontsize=9)
    axes.legend(fontsize=8, frameon=False)
    _plain(axes)


def _return_around_event(axes: Any, rows: TaskRows) -> None:
    """Mean and 5 to 95 % of the return over the time since the event of each episode."""
    since = _since_event(rows)
    ticks, bands = [], []
    for tick in range(*_AROUND):
        values = rows.mc_return[(since == tick) & rows.mc_valid]
        if len(values) >= 5:
            ticks.append(tick)
            bands.append([*np.quantile(values, (0.05, 0.5, 0.95)), values.mean()])
    if ticks:
        low, middle, high, mean = np.array(bands).T
        time = np.array(ticks) * PLANNER_DT
        colour = _COLOURS[rows.task]
        axes.fill_between(time, low, high, color=colour, alpha=0.2, lw=0, label="5 to 95 %")
        axes.plot(time, middle, color=colour, lw=1, ls="--", label="median")
        axes.plot(time, mean, color=colour, lw=2, label="mean")
        axes.axvline(0.0, color="0.6", lw=0.8)
        axes.legend(fontsize=8, frameon=False)
    axes.set_xlabel("s since the event", fontsize=9)
    axes.set_ylabel("return", fontsize=9)
    _plain(axes)


def _since_event(rows: TaskRows) -> NDArray[np.int64]:
    """(N,) ticks since the episode's event; far out of sight where there is none."""
    ticks = [facts.get("event_tick") for facts in rows.metadata]
    events = np.array([10**9 if tick is None else tick for tick in ticks], dtype=np.int64)
    since: NDArray[np.int64] = np.arange(len(rows.reward)) - np.repeat(
        rows.start + events, rows.length
    )
    return since


def _actions(found: Survey) -> Any:
    """A histogram per action, then where the targets of each hand lie, seen from two sides."""
    figure = _figure(12.6, 5.6)
    top, bottom = figure.subfigures(2, 1, height_ratios=[1.0, 1.5])
    panels = top.subplots(1, len(ACTION_NAMES), sharey=True)
    for axes, name in zip(panels, ACTION_NAMES, strict=True):
        _action_histogram(axes, found.tasks, name)
    panels[0].set_ylim(0, None)  # shared by all panels
    panels[0].set_ylabel("density (even: 1)", fontsize=9)
    if len(found.tasks) > 1:
        panels[-1].legend(fontsize=7, frameon=False, loc="lower center")
    _densities(bottom, found)
    return figure


def _action_histogram(axes: Any, tasks: Sequence[TaskSurvey], name: str) -> None:
    edges = np.linspace(-1.0, 1.0, BINS + 1)
    for task in tasks:
        counts = np.array(task.action.histogram[name])
        density = counts / counts.sum() * BINS
        axes.stairs(density, edges, color=_COLOURS[task.task], lw=1.4, label=task.task)
    axes.axhline(1.0, color="0.7", lw=0.8, zorder=0)
    axes.set(xlim=(-1, 1), xticks=[-1, 0, 1])
    axes.set_title(name.replace("_", " "), fontsize=9)
    _plain(axes)


def _densities(figure: Any, found: Survey) -> None:
    action = np.concatenate([rows.action for rows in found.rows])
    metric = ACTION_BOX.to_metric(action[:: 1 + len(action) // _DENSITY_ROWS])
    palms = np.concatenate([sample.palms_b for sample in found.samples])
    views = [(hand, across) for across in (0, 1) for hand in (0, 1)]
    for axes, (hand, across) in zip(figure.subplots(1, 4), views, strict=True):
        targets = metric[:, 3 * hand : 3 * hand + 3]
        _density(axes, targets[:, across], targets[:, 2], hand, across)
        shown = palms[:: 1 + len(palms) // 1500, hand]
        axes.plot(shown[:, across], shown[:, 2], ".", ms=1.2, color="#e8710a", alpha=0.5)
        side = "from the side" if across == 0 else "from behind"
        axes.set_title(f"{('left', 'right')[hand]} hand, {side}", fontsize=9)
        if across == 1:
            axes.invert_xaxis()  # y points left
    figure.supxlabel(
        "grey: where hand targets were sent, m in the pelvis heading frame (darker: more often); "
        "orange: where the palms were",
        fontsize=9,
    )


def _density(
    axes: Any, across: NDArray[np.float64], up: NDArray[np.float64], hand: int, axis: int
) -> None:
    i = 3 * hand + axis
    edges = (
        np.linspace(ACTION_BOX.low[i], ACTION_BOX.high[i], 25),
        np.linspace(ACTION_BOX.low[2], ACTION_BOX.high[2], 25),
    )
    counts, *_ = np.histogram2d(across, up, bins=edges)
    # the box is denser below the neutral pose, where it is short: square roots show the rest, too
    axes.pcolormesh(*edges, np.sqrt(counts.T), cmap="Greys", vmin=0)
    axes.set_aspect("equal")
    axes.set_xlabel("xyz"[axis] + " (m)", fontsize=9)
    axes.set_ylabel("z (m)", fontsize=9)
    _plain(axes)


def _depth(found: Survey) -> Any:
    """Film strips of example episodes."""
    strips = [
        (rows.task, strip)
        for rows, sample in zip(found.rows, found.samples, strict=True)
        for strip in sample.strips
    ]
    figure = _figure(1.5 * FRAMES + 1.0, 1.4 * len(strips) + 0.3)
    colours = _depth_colours()
    grid = figure.subplots(len(strips), 1, squeeze=False)[:, 0]
    for axes, (task, strip) in zip(grid, strips, strict=True):
        _film_strip(axes, strip, colours)
        axes.set_ylabel(f"{task}\nepisode {strip.episode}", fontsize=9)
    bar = figure.colorbar(colours, ax=grid, fraction=0.02, pad=0.01)
    bar.set_label("depth (m); grey: not measured", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return figure


def _film_strip(axes: Any, strip: FilmStrip, colours: Any) -> None:
    """The frames side by side in one picture: far quicker to draw than one for each."""
    rows, cols = strip.depth.shape[1:]
    pitch = cols + _GAP
    film = np.full((rows, FRAMES * pitch - _GAP, 4), 255, np.uint8)
    for i, depth in enumerate(strip.depth):
        metres = np.where(depth > 0, depth / 1000.0, np.nan)
        film[:, i * pitch : i * pitch + cols] = colours.cmap(colours.norm(metres), bytes=True)
    axes.imshow(film)
    axes.xaxis.tick_top()
    middles = [i * pitch + cols / 2 for i in range(len(strip.tick))]
    axes.set_xticks(middles, [f"{tick * PLANNER_DT:.2f} s" for tick in strip.tick], fontsize=8)
    axes.tick_params(length=0, pad=1)
    axes.set_yticks([])
    axes.spines[:].set_visible(False)


def _depth_colours() -> Any:
    """Metres -> colour: near yellow, far dark blue, grey where nothing was measured."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colours = colormaps["viridis_r"].with_extremes(bad="0.8")
    return ScalarMappable(Normalize(0.0, DEPTH_MAX_M), colours)
