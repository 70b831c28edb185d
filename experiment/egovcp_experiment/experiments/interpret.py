"""Value of hand positions, predicted images, and behaviour with and without events (figure 7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from egovcp_experiment import results
from egovcp_experiment.grid import Grid
from egovcp_experiment.report import (
    ExperimentReport,
    Plot,
    Table,
    draw,
    number,
    percent,
    percent_range,
)
from egovcp_experiment.studies.behaviour import NEAR_NEUTRAL_M
from egovcp_experiment.studies.open_loop import HORIZONS


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    page = ExperimentReport(
        "Interpretation: values, open-loop predictions, and behaviour with and without events"
    )
    studies = {
        "value_maps": _add_value_maps,
        "open_loop": _add_open_loop,
        "behaviour": _add_behaviour,
    }
    for name, add in config.chosen(studies).items():
        tasks = [task for task in config.tasks if task == "ball" or name != "value_maps"]
        for task in tasks:
            flags = {"task": task, "episodes": config.play.episodes}
            cell = grid.sim_study(name, task, flags)
            if cell in records:
                found = records[cell]["figures"]
                drawn_only = ("maps", "strips", "x", "z")
                page.figures[cell] = {k: v for k, v in found.items() if k not in drawn_only}
                add(page, task, found)
    return page


def _add_value_maps(page: ExperimentReport, task: str, found: Mapping[str, Any]) -> None:
    summary = found["summary"]
    rows = [
        (name, str(row["episodes"]), f"{row['spread']:.3f}", f"{100 * row['height_error_m']:.1f}")
        for name, row in summary.items()
    ]
    spread = "best - worst (standard deviations of the return)"
    head = ("flight", "episodes", spread, "height error (cm)")
    page.sections += [
        "Q of the planned action with the target of that hand moved over its x-z plane, all else "
        "equal. Height error: between the best point of the map and the height of the ball's aim.",
        Table("Value map of the hand on the ball's side, means over episodes", head, rows),
    ]
    if found["maps"]:
        page.sections.append(_map_plot(found))
    if {"before", "75%"} <= summary.keys():
        before, late = summary["before"], summary["75%"]
        page.findings.append(
            f"{task}: the value map of a hand spans {before['spread']:.2f} standard deviations "
            f"of the return before the throw and {late['spread']:.2f} at 75 % of the flight; the "
            f"best point is {100 * before['height_error_m']:.0f} and "
            f"{100 * late['height_error_m']:.0f} cm off the ball's height"
        )


def _edges(centres: Sequence[float]) -> tuple[float, float]:
    """Outer edges of cells that are equally far apart."""
    half = (centres[1] - centres[0]) / 2
    return centres[0] - half, centres[-1] + half


def _map_plot(found: Mapping[str, Any]) -> Plot:
    maps, x, z = found["maps"], found["x"], found["z"]
    values = np.array([m["values"] for m in maps])

    def paint(figure: Any) -> None:
        axes = figure.subplots(1, len(maps), sharey=True, squeeze=False)[0]
        for at, shown, value in zip(axes, maps, values, strict=True):
            image = at.imshow(
                value,
                origin="lower",
                extent=(*_edges(x), *_edges(z)),
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
        figure.colorbar(image, ax=axes, shrink=0.7, label="Q")

    return draw(
        "value-map",
        f"Q over the x-z plane of the {maps[0]['hand']} hand, before the throw and at shares of "
        "the flight, one colour scale; cross: best; dotted: the height at which the ball was aimed",
        paint,
        (9.0, 3.0),
    )


def _add_open_loop(page: ExperimentReport, task: str, found: Mapping[str, Any]) -> None:
    errors = found["errors_m"]
    last = errors[str(HORIZONS[-1])]
    head = ("ticks ahead", "model (cm)", "repeat (cm)", "moving: model (cm)", "moving: repeat (cm)")
    title = (
        f"{task}: open-loop depth under the actions that were sent, {found['episodes']} episodes"
    )
    columns = ("model", "repeat", "model_moving", "repeat_moving")
    rows = [(k, *(_centimetres(row[c]) for c in columns)) for k, row in errors.items()]
    page.sections.append(Table(title, head, rows))
    if last["model_moving"] is not None:
        page.findings.append(
            f"{task}: {HORIZONS[-1]} ticks ahead, the error on moving pixels is "
            f"{100 * last['model_moving']:.0f} cm, that of repeating the last image "
            f"{100 * last['repeat_moving']:.0f} cm"
        )
    if found["strips"]:
        page.sections.append(_strip_plot(task, found["strips"]))


def _centimetres(metres: float | None) -> str:
    return number(None if metres is None else 100 * metres, ".1f")


def _strip_plot(task: str, strips: Sequence[Mapping[str, Any]]) -> Plot:
    def paint(figure: Any) -> None:
        rows = [(kind, strip[kind]) for strip in strips for kind in ("seen", "imagined")]
        axes = figure.subplots(len(rows), len(HORIZONS), squeeze=False)
        for at, k in zip(axes[0], HORIZONS, strict=True):
            at.set_title("filtered" if k == 0 else f"+{k}", fontsize=8)
        for line, (kind, images) in zip(axes, rows, strict=True):
            for at, image in zip(line, images, strict=True):
                depth = np.array(image, float) / 100
                at.imshow(np.where(depth > 0, depth, np.nan), cmap="viridis_r", vmin=0.3, vmax=4.0)
                at.set(xticks=[], yticks=[])
            line[0].set_ylabel(kind, fontsize=8)

    caption = f"{task}: observed images, and below those imagined open-loop from the first one"
    return draw(f"open-loop-{task}", caption, paint, (9.0, 0.3 + 0.85 * 2 * len(strips)))


#: Metric of the study -> its name in the table.
_BEHAVIOUR: Final = {
    "empty_scene": "distance of the hands from their start, no event (cm)",
    "before_throw": "distance of the hands from their start, before the throw (cm)",
    "after_throw": "distance of the hands from their start, after the throw (cm)",
    "empty_scene_effort": "mean squared action, no event (%)",
    "undisturbed_without_contact": "undisturbed scenes without contact",
    "hands_back": "both hands within 10 cm of neutral at most 2 s after recovering from a push",
    "pelvis_far": "pelvis while no arch is near (cm)",
    "standing_far": "ticks above 0.70 m while no arch is near (%)",
    "pelvis_near": "pelvis while an arch is near (cm)",
}


def _add_behaviour(page: ExperimentReport, task: str, found: Mapping[str, Any]) -> None:
    rows = []
    for key, name in _BEHAVIOUR.items():
        if key in found:
            row = found[key]
            if row["ci95"] is None:
                shown = ("-", "-")
            elif "share" in row:
                shown = (percent(row["share"]), percent_range(row["ci95"]))
            else:
                low, high = row["ci95"]
                shown = (f"{100 * row['mean']:.1f}", f"{100 * low:.1f} to {100 * high:.1f}")
            rows.append((name, *shown, str(row["episodes"])))
    page.sections.append(Table(f"{task}: behaviour", ("", "mean", "95 %", "episodes"), rows))
    page.findings += _behaviour_conclusion(task, found)


def _behaviour_conclusion(task: str, found: Mapping[str, Any]) -> list[str]:
    if task == "ball" and found["after_throw"]["mean"] is not None:
        empty, after = found["empty_scene"], found["after_throw"]
        if empty["ci95"][0] > NEAR_NEUTRAL_M:
            word = "raised in empty scenes, too"
        elif after["ci95"][0] > empty["ci95"][1]:
            word = "raised for the ball"
        else:
            word = "not raised"
        return [
            f"ball: hands are {100 * empty['mean']:.0f} cm from their start in an empty scene, "
            f"{100 * after['mean']:.0f} cm after a throw: {word}"
        ]
    if task == "wall":
        untouched, back = found["undisturbed_without_contact"], found["hands_back"]
        return [
            f"wall: {percent(untouched['share'])} of undisturbed scenes without contact (bar 95 %)"
            f"; hands back after {percent(back['share'])} of {back['episodes']} recoveries, of "
            f"{found['pushed']} pushes towards the wall; the oracle braces for "
            f"{found['braced_for_s']:g} s"
        ]
    if task == "arch" and found["pelvis_far"]["mean"] is not None:
        return [
            f"arch: the pelvis is at {found['pelvis_far']['mean']:.2f} m while no arch is near "
            f"(bar 0.70 m), above 0.70 m in {percent(found['standing_far']['mean'])} of these ticks"
        ]
    return []
