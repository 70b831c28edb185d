"""What a hand's place is worth, what is foreseen, and whether there is a reason to act (fig. 7)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from egovcp_experiment.cell import Cell
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.experiment import Experiment
from egovcp_experiment.grid import Grid
from egovcp_experiment.report.document import Plot, Report, Table, number, percent, percent_range
from egovcp_experiment.report.svg import drawn
from egovcp_experiment.store import Record
from egovcp_experiment.studies.open_loop import HORIZONS
from egovcp_experiment.tools import study

#: Ticks ahead at which the ball's errors are summed up in one line.
BALL_HORIZONS: Final = (4, 8, 12, 16)
#: Study -> the tasks that it is of; empty: all.
STUDIES: Final[dict[str, tuple[str, ...]]] = {
    "value_maps": ("ball",),
    "open_loop": (),
    "behaviour": (),
}


def _studied(config: ExperimentConfig, grid: Grid) -> dict[tuple[str, str], str]:
    """(study, task) -> name of its cell; of the first training seed."""
    found = {}
    for name, tasks in config.chosen(STUDIES).items():
        for task in config.tasks:
            if tasks and task not in tasks:
                continue
            flags = {
                **grid.planner(task),
                "policy.path": grid.model(task, config.train.seeds[0]),
                "task": task,
                "episodes": config.play.episodes,
                "seed": config.play.seed,
            }
            cell = Cell(f"{name}-{task}", study(name), flags, config.scenes)
            found[name, task] = grid.add(cell).name
    return found


def _cells(config: ExperimentConfig) -> list[Cell]:
    grid = Grid(config)
    _studied(config, grid)
    return grid.cells


def _report(config: ExperimentConfig, records: Mapping[str, Record]) -> Report:
    shows: list[str] = []
    parts: list[str | Table | Plot] = []
    figures: dict[str, Any] = {}
    for (name, task), cell in _studied(config, Grid(config)).items():
        if cell not in records:
            continue
        found = records[cell]["figures"]
        figures[f"{name}-{task}"] = {
            k: v for k, v in found.items() if k not in ("maps", "strips", "x", "z")
        }
        lines, more = {"value_maps": _maps, "open_loop": _foreseen, "behaviour": _behaviour}[name](
            task, found
        )
        shows += lines
        parts += more
    title = "Interpretation: what the model values and foresees, and whether it acts for a reason"
    return Report(title, tuple(shows), tuple(parts), figures)


type _Section = tuple[list[str], list[str | Table | Plot]]


def _maps(task: str, found: Mapping[str, Any]) -> _Section:
    summary = found["summary"]
    rows = tuple(
        (name, str(row["episodes"]), f"{row['spread']:.3f}", f"{100 * row['height_error_m']:.1f}")
        for name, row in summary.items()
    )
    head = ("flight", "episodes", "best - worst (deviations of the return)", "height off (cm)")
    table = Table("Value map of the hand on the ball's side, means over episodes", head, rows)
    words = (
        "Q of the planned action with that hand's target moved over its x-z plane, everything else "
        "held. Height off: from the best point of the map to the height the ball was aimed at."
    )
    parts: list[str | Table | Plot] = [words, table]
    if found["maps"]:
        parts.append(_map_plot(found))
    lines = []
    if "before" in summary and "75%" in summary:
        before, late = summary["before"], summary["75%"]
        lines.append(
            f"{task}: the value of a hand's place spreads over {before['spread']:.2f} deviations "
            f"of the return before the throw and {late['spread']:.2f} at 75 % of the flight; the "
            f"best place is {100 * before['height_error_m']:.0f} and "
            f"{100 * late['height_error_m']:.0f} cm off the ball's height"
        )
    return lines, parts


def _map_plot(found: Mapping[str, Any]) -> Plot:
    maps, x, z = found["maps"], found["x"], found["z"]
    values = np.array([m["values"] for m in maps])

    def paint(figure: Any) -> None:
        axes = figure.subplots(1, len(maps), sharey=True, squeeze=False)[0]
        for at, shown, value in zip(axes, maps, values, strict=True):
            picture = at.imshow(
                value,
                origin="lower",
                extent=(x[0], x[-1], z[0], z[-1]),
                vmin=values.min(),
                vmax=values.max(),
                cmap="viridis",
                aspect="equal",
            )
            at.plot(*shown["best"], "w+", markersize=8)
            at.axhline(found["aim"][1], color="w", linewidth=0.6, linestyle=":")
            at.set_title(f"{shown['moment']} (tick {shown['tick']})", fontsize=8)
            at.set_xlabel("x (m)")
        axes[0].set_ylabel("z (m)")
        figure.colorbar(picture, ax=axes, shrink=0.7, label="Q")

    return drawn(
        "value-map",
        f"Q over the x-z plane of the {maps[0]['hand']} hand, before the throw and at shares of "
        "the flight, one colour scale; cross: best; dotted: the height at which the ball was aimed",
        paint,
        (9.0, 3.0),
    )


def _foreseen(task: str, found: Mapping[str, Any]) -> _Section:
    errors = found["errors_m"]
    rows = tuple(
        (
            str(k),
            *(_centimetres(row[c]) for c in ("model", "repeat", "model_moving", "repeat_moving")),
        )
        for k, row in errors.items()
    )
    head = ("ticks ahead", "model (cm)", "repeat (cm)", "moving: model (cm)", "moving: repeat (cm)")
    table = Table(
        f"{task}: open-loop depth under the actions that were sent, {found['episodes']} episodes",
        head,
        rows,
    )
    tables: list[str | Table | Plot] = [table]
    last = errors[str(HORIZONS[-1])]
    lines = []
    if last["model_moving"] is not None:
        lines.append(
            f"{task}: {HORIZONS[-1]} ticks ahead, moving pixels are foreseen to "
            f"{100 * last['model_moving']:.0f} cm; repeating the last picture is "
            f"{100 * last['repeat_moving']:.0f} cm off"
        )
    if "ball_images" in last:
        tables.append(_ball_table(errors))
        lines += _ball_line(errors)
    return lines, [*tables, *([_strip_plot(task, found["strips"])] if found["strips"] else [])]


def _ball_table(errors: Mapping[str, Mapping[str, Any]]) -> Table:
    rows = tuple(
        (
            str(k),
            str(row["ball_images"]),
            _centimetres(row["model_ball"]),
            _centimetres(row["repeat_ball"]),
            percent(row["ball_detected"]),
        )
        for k, row in errors.items()
    )
    head = ("ticks ahead", "images of the ball", "model (cm)", "repeat (cm)", "detected")
    return Table(
        "ball: depth of the ball's pixels in the decoded image; detected: the median error is "
        "below 30 cm",
        head,
        rows,
    )


def _ball_line(errors: Mapping[str, Mapping[str, Any]]) -> list[str]:
    rows = [errors[str(k)] for k in BALL_HORIZONS]
    if all(row["model_ball"] is None for row in rows):
        return []
    ahead = ", ".join(map(str, BALL_HORIZONS))
    model, repeat = (
        ", ".join(_centimetres(row[name], ".0f") for row in rows)
        for name in ("model_ball", "repeat_ball")
    )
    return [
        f"ball: {ahead} ticks ahead, the depth of the ball in the decoded image is off by "
        f"{model} cm; repeating the last picture by {repeat} cm"
    ]


def _centimetres(metres: float | None, form: str = ".1f") -> str:
    return number(None if metres is None else 100 * metres, form)


def _strip_plot(task: str, strips: list[Mapping[str, Any]]) -> Plot:
    def paint(figure: Any) -> None:
        rows = [(kind, strip[kind]) for strip in strips for kind in ("seen", "foreseen")]
        axes = figure.subplots(len(rows), len(HORIZONS), squeeze=False)
        for at, k in zip(axes[0], HORIZONS, strict=True):
            at.set_title("filtered" if k == 0 else f"+{k}", fontsize=8)
        for line, (kind, pictures) in zip(axes, rows, strict=True):
            for at, picture in zip(line, pictures, strict=True):
                depth = np.array(picture, float) / 100
                at.imshow(np.where(depth > 0, depth, np.nan), cmap="viridis_r", vmin=0.3, vmax=4.0)
                at.set(xticks=[], yticks=[])
            line[0].set_ylabel(kind, fontsize=8)

    caption = (
        f"{task}: pictures that came, and below what was foreseen from the first on without looking"
    )
    return drawn(f"open-loop-{task}", caption, paint, (9.0, 0.3 + 0.85 * 2 * len(strips)))


def _behaviour(task: str, found: Mapping[str, Any]) -> _Section:
    names = {
        "empty_scene": "hands from where they started, nothing happening (cm)",
        "before_throw": "hands from where they started, before the throw (cm)",
        "after_throw": "hands from where they started, after the throw (cm)",
        "empty_scene_effort": "mean squared action, nothing happening (%)",
        "undisturbed_without_contact": "undisturbed scenes without contact",
        "hands_back": "hands back within 10 cm and 2 s of recovery from a push",
        "pelvis_far": "pelvis while no arch is near (cm)",
        "standing_far": "ticks above 0.70 m while no arch is near (%)",
        "pelvis_near": "pelvis while an arch is near (cm)",
    }
    rows = tuple(
        (words, *_measured(found[key]), str(found[key]["episodes"]))
        for key, words in names.items()
        if key in found
    )
    table = Table(f"{task}: behaviour", ("", "mean", "95 %", "episodes"), rows)
    lines = []
    if task == "ball":
        empty, after = found["empty_scene"]["mean"], found["after_throw"]["mean"]
        if after is not None:
            lines.append(
                f"ball: hands are {100 * empty:.0f} cm from where they started in an empty scene, "
                f"{100 * after:.0f} cm after a throw: "
                + ("they rise for the ball" if after > 1.5 * empty else "a guard that is always up")
            )
    if task == "wall":
        untouched, back = found["undisturbed_without_contact"], found["hands_back"]
        lines.append(
            f"wall: {percent(untouched['share'])} of undisturbed scenes without contact (bar 95 %)"
            f"; hands back after {percent(back['share'])} of {back['episodes']} recoveries, of "
            f"{found['pushed']} pushes towards the wall; a brace is rewarded for "
            f"{found['braced_for_s']:g} s"
        )
    if task == "arch" and found["pelvis_far"]["mean"] is not None:
        lines.append(
            f"arch: the pelvis is at {found['pelvis_far']['mean']:.2f} m while no arch is near "
            f"(bar 0.70 m), above 0.70 m in {percent(found['standing_far']['mean'])} of these ticks"
        )
    return lines, [table]


def _measured(row: Mapping[str, Any]) -> tuple[str, str]:
    if "share" in row:
        return percent(row["share"]), percent_range(row["ci95"])
    if row["mean"] is None:
        return "-", "-"
    low, high = row["ci95"]
    return f"{100 * row['mean']:.1f}", f"{100 * low:.1f} to {100 * high:.1f}"


EXPERIMENT: Final = Experiment(
    "value maps of a hand, open-loop pictures, and behaviour where nothing happens (fig. 7)",
    _cells,
    _report,
)
