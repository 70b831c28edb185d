"""Value of hand positions, predicted images, and behaviour with and without events (figure 7)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from egovcp.plan import PlannerConfig
from egovcp_experiment import results
from egovcp_experiment.experiments.table1 import MODELS
from egovcp_experiment.grid import DEFAULT, Grid, Model
from egovcp_experiment.report import ExperimentReport, Plot, Table, draw, number, percent
from egovcp_experiment.studies.behaviour import NEAR_START_M
from egovcp_experiment.studies.open_loop import HORIZONS

#: Ticks ahead of the open-loop errors in the lead: the horizon of the planner, and the last.
_AHEAD: Final = (PlannerConfig().horizon, HORIZONS[-1])
#: Of `table1`.
_ARWM: Final = Model("arwm", MODELS["arwm"])


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    page = ExperimentReport(
        "Interpretation: values, open-loop predictions, and behaviour with and without events",
        note="Intervals are 95 %, over scenarios.",
    )
    studies = {
        "value_maps": _add_value_maps,
        "open_loop": _add_open_loop,
        "behaviour": _add_behaviour,
    }
    for name, add in config.chosen(studies).items():
        found_by_title: dict[str, Mapping[str, Any]] = {}
        tasks = [task for task in config.tasks if task == "ball" or name != "value_maps"]
        cells = {task: (task, Model()) for task in tasks}
        if name == "behaviour" and "wall" in tasks and not grid.given_policy(grid.trained_on):
            cells["wall, ARWM"] = "wall", _ARWM
        for title, (task, model) in cells.items():
            flags = {"task": task, "episodes": config.play.episodes}
            place = task if model.name == DEFAULT else f"{task}-{model.name}"
            cell = grid.sim_study(name, place, flags, model)
            if cell in records:
                found = found_by_title[title] = records[cell]["metrics"]
                drawn_only = ("maps", "strips", "x", "z")
                page.metrics[cell] = {k: v for k, v in found.items() if k not in drawn_only}
        if found_by_title:
            add(page, found_by_title)
    return page


type Results = Mapping[str, Mapping[str, Any]]
"""Title, a task and its model unless that is the default -> result of a study."""


def _add_value_maps(page: ExperimentReport, found_by_title: Results) -> None:
    (found,) = found_by_title.values()  # of the ball
    summary = found["summary"]
    rows = [
        (name, str(row["episodes"]), f"{row['spread']:.3f}", f"{100 * row['height_error_m']:.1f}")
        for name, row in summary.items()
    ]
    spread = "best - worst (standard deviations of the return)"
    head = ("flight", "episodes", spread, "height error (cm)")
    page.sections += [
        "J, Q minus the known cost of holding that pose, of the planned action with the target of "
        "that hand moved over its x-z plane, all else equal. Q was fitted only to what the rate "
        "limit can reach from the last action. Height error: between the best point of the map and "
        "the height of the ball's aim.",
        Table("Value map of the hand on the ball's side, means over episodes", head, rows),
    ]
    if found["maps"]:
        page.plot = _map_plot(found)
    if {"before", "75%"} <= summary.keys():
        before, late = (summary[name]["height_error_m"] for name in ("before", "75%"))
        page.lead.append(
            f"The hand position of the highest value is {100 * before:.0f} cm above or below the "
            f"ball's height before the throw, and {100 * late:.0f} cm at 75 % of the flight."
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
            (left, right), (bottom, top) = shown["reach"]
            frame = [left, right, right, left, left], [bottom, bottom, top, top, bottom]
            at.plot(*frame, color="w", linewidth=0.8)
            at.axhline(found["aim"][1], color="w", linewidth=0.6, linestyle=":")
            at.set_title(f"{shown['moment']} (tick {shown['tick']})", fontsize=8)
            at.set_xlabel("x (m)")
        axes[0].set_ylabel("z (m)")
        figure.colorbar(image, ax=axes, shrink=0.7, label="J")

    return draw(
        "value-map",
        f"J (Q minus the cost of holding the pose) over the x-z plane of the {maps[0]['hand']} "
        "hand, before the throw and at shares of the flight, one colour scale; cross: best; frame: "
        "what the rate limit can reach from the last action, to which alone Q was fitted; dotted: "
        "the height at which the ball was aimed",
        paint,
        (9.0, 3.0),
    )


def _add_open_loop(page: ExperimentReport, found_by_title: Results) -> None:
    ahead: dict[int, list[str]] = {k: [] for k in _AHEAD}
    for task, found in found_by_title.items():
        errors = found["errors_m"]
        head = (
            *("ticks ahead", "model (cm)", "repeat (cm)"),
            *("changed: model (cm)", "changed: repeat (cm)"),
        )
        title = (
            f"{task}: open-loop depth under the actions that were sent, {found['episodes']} "
            "episodes, all valid pixels; changed: those where repeating the last image is wrong by "
            "more than 20 cm, so that there it loses by construction"
        )
        columns = ("model", "repeat", "model_changed", "repeat_changed")
        rows = [(k, *(_centimetres(row[c]) for c in columns)) for k, row in errors.items()]
        page.sections.append(Table(title, head, rows))
        if found["strips"]:
            plot = _strip_plot(task, found["strips"])
            if page.plot is None:
                page.plot = plot
            else:
                page.sections.append(plot)
        for k, words in ahead.items():
            error = errors[str(k)]
            if error["model"] is not None:
                model, repeat = (_centimetres(error[name]) for name in ("model", "repeat"))
                words.append(f"{task} {model} cm ({repeat} cm)")
    lines = [f"{k} ticks ahead {', '.join(words)}" for k, words in ahead.items() if words]
    if lines:
        page.lead.append(
            "The mean error of imagined depth (in brackets: of repeating the last image) is "
            f"{'; '.join(lines)}."
        )


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


#: Metric of the study -> its name in the table, and its factor there.
_BEHAVIOUR: Final = {
    "empty_scene": ("distance of the hands from their start, no event (cm)", 100),
    "before_throw": ("distance of the hands from their start, before the throw (cm)", 100),
    "after_throw": ("distance of the hands from their start, after the throw (cm)", 100),
    "empty_scene_effort": ("mean squared action, no event (%)", 100),
    "undisturbed_without_contact": ("undisturbed scenes without contact (%)", 100),
    "hand_contact": ("pushes with a hand on the wall (%)", 100),
    "contact_s": ("time from the push to the first hand on the wall (s)", 1),
    "bracing_q": ("Q of the oracle's bracing pose above the neutral pose (sd of the return)", 1),
    "bracing_j": ("the same minus the costs of holding them (sd of the return)", 1),
    "hands_back": (
        "both hands within 10 cm of their start at some time in the 2 s after a recovery (%)",
        100,
    ),
    "pelvis_far": ("pelvis while no arch is near (cm)", 100),
    "standing_far": ("ticks above 0.70 m while no arch is near (%)", 100),
    "pelvis_near": ("pelvis while an arch is near (cm)", 100),
}


def _add_behaviour(page: ExperimentReport, found_by_title: Results) -> None:
    words = []
    for title, found in found_by_title.items():
        rows = [
            (name, *_with_interval(found[key], factor), str(found[key]["episodes"]))
            for key, (name, factor) in _BEHAVIOUR.items()
            if key in found
        ]
        page.sections.append(Table(f"{title}: behaviour", ("", "mean", "95 %", "episodes"), rows))
        if title in _CONCLUSIONS and (word := _CONCLUSIONS[title](found)):
            words.append(word)
        if "hand_contact" in found:
            page.findings += _bracing(title, found)
    if words:
        page.lead.append(f"Behaviour: {'; '.join(words)}.")


def _with_interval(row: Mapping[str, Any], factor: float) -> tuple[str, str]:
    if row["ci95"] is None:
        return "-", "-"
    middle = row["share"] if "share" in row else row["mean"]
    form = ".1f" if factor == 100 else ".2f"
    low, high = (format(factor * end, form) for end in row["ci95"])
    return format(factor * middle, form), f"{low} to {high}"


def _bracing(title: str, found: Mapping[str, Any]) -> list[str]:
    """Whether the hands reach the wall, and whether Q prefers that."""
    contact, q, j = found["hand_contact"]["share"], found["bracing_q"], found["bracing_j"]
    if contact is None or q["mean"] is None:
        return []
    low, high = q["ci95"]
    word = "prefers" if low > 0 else "does not prefer" if high < 0 else "may prefer"
    return [
        f"{title}: a hand touches the wall after {percent(contact)} of the pushes; Q {word} the "
        f"oracle's bracing pose to the neutral one, by {q['mean']:+.2f} standard deviations of the "
        f"return ({j['mean']:+.2f} with the costs of holding them)"
    ]


def _ball(found: Mapping[str, Any]) -> str:
    empty, after = found["empty_scene"], found["after_throw"]
    if after["mean"] is None:
        return ""
    if empty["ci95"][0] > NEAR_START_M:
        word = "raised in empty scenes, too"
    elif after["ci95"][0] > empty["ci95"][1]:
        word = "raised for the ball"
    else:
        word = "not raised"
    return (
        f"hands are {100 * empty['mean']:.0f} cm from their start in a scene without a ball and "
        f"{100 * after['mean']:.0f} cm after a throw ({word})"
    )


def _wall(found: Mapping[str, Any]) -> str:
    untouched, back = found["undisturbed_without_contact"], found["hands_back"]
    return (
        f"{percent(untouched['share'])} of undisturbed scenes at the wall are without contact, and "
        f"hands are back after {percent(back['share'])} of the recoveries"
    )


def _arch(found: Mapping[str, Any]) -> str:
    if found["pelvis_far"]["mean"] is None:
        return ""
    return f"the pelvis is at {found['pelvis_far']['mean']:.2f} m while no arch is near"


_CONCLUSIONS: Final = {"ball": _ball, "wall": _wall, "arch": _arch}
