"""Results of closed-loop and held-out evaluations: statistics, tables and plots."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from egovcp.eval_scores import Array, EvalScores, signed_range
from egovcp_experiment.cell import Record
from egovcp_experiment.report import Plot, Table, draw, number, percent, percent_range

type Records = Mapping[str, Record]


def eval_scores(
    records: Records, cells: Iterable[str], task: str, controller: str = "planner"
) -> EvalScores | None:
    """Scores of a controller on a task from cells, one per seed; None if all are missing."""
    rows = [records[name]["metrics"][task][controller] for name in cells if name in records]
    if not rows:
        return None

    def column(name: str) -> Array:
        return np.array([row["played"][name] for row in rows], np.float64)

    parts = {
        part: np.array([row["played"]["parts"][part] for row in rows], np.float64)
        for part in rows[0]["played"].get("parts", ())
    }
    times = tuple(float(row["plan_ms_p50"]) for row in rows)
    return EvalScores(column("reward"), column("steps"), column("success"), times, parts)


def all_scores[K](
    records: Records, plays: Mapping[K, Sequence[str]], task: str, controller: str = "planner"
) -> dict[K, EvalScores]:
    """Scores of each variant that has results, from the names of its cells."""
    found = {k: eval_scores(records, cells, task, controller) for k, cells in plays.items()}
    return {k: scores for k, scores in found.items() if scores is not None}


def controller_scores(
    records: Records, cell: str, task: str, controllers: Iterable[str]
) -> dict[str, EvalScores]:
    """Scores of the controllers that one cell played."""
    found = {name: eval_scores(records, [cell], task, name) for name in controllers}
    return {name: scores for name, scores in found.items() if scores is not None}


def metrics_of(scores: Mapping[Any, EvalScores]) -> dict[str, Any]:
    """Name -> metrics."""
    return {str(name): each.figures() for name, each in scores.items()}


def comparison(title: str, scores: Mapping[str, EvalScores], reference: str) -> Table:
    """Success and reward of each, and paired differences to ``reference``."""
    head = ["", "success", "reward per step"]
    spreads = any(each.reward_spread is not None for each in scores.values())
    if spreads:
        head.append("its sd over trainings")
    base = scores.get(reference)
    if base is not None:
        head += [f"success above {reference} (points)", f"reward above {reference}"]
    rows = []
    for name, each in scores.items():
        row = [
            name,
            f"{percent(each.success_rate)} ({percent_range(each.success_interval)})",
            f"{each.reward_per_step:+.5f} ({signed_range(each.reward_interval)})",
        ]
        if spreads:
            row.append(number(each.reward_spread, ".5f"))
        if base is not None:
            row += [""] * 2 if each is base else each.gain(base).columns()
        rows.append(row)
    return Table(title, head, rows)


def _success_percent(scores: EvalScores) -> tuple[float, float, float]:
    low, high = scores.success_interval
    return 100 * scores.success_rate, 100 * low, 100 * high


#: Label of an axis -> value and interval.
_QUANTITIES: Final[Mapping[str, Callable[[EvalScores], tuple[float, float, float]]]] = {
    "success, %": _success_percent,
    "reward per step": lambda scores: (scores.reward_per_step, *scores.reward_interval),
}


@dataclass(frozen=True)
class Curve:
    """Scores of one learner against a number of transitions or of gradient steps."""

    label: str
    points: Mapping[int, EvalScores]
    """Number -> scores."""
    colour: str
    """Of Matplotlib."""
    style: str = "o-"
    """Of Matplotlib."""


def learning_curves(name: str, caption: str, panels: Mapping[str, Sequence[Curve]]) -> Plot:
    """Success and reward with 95 % intervals; ``panels`` has the curves by the label of x."""

    def paint(figure: Any) -> None:
        rows = figure.subplots(len(panels), 2, squeeze=False)
        for row, (x_label, curves) in zip(rows, panels.items(), strict=True):
            for axes, (y_label, quantity) in zip(row, _QUANTITIES.items(), strict=True):
                for curve in curves:
                    _paint_curve(axes, curve, quantity)
                axes.set(xlabel=x_label, ylabel=y_label)
            row[0].legend(fontsize=8)

    return draw(name, f"{caption}, 95 % intervals", paint, (8.0, 3.0 * len(panels)))


def _paint_curve(
    axes: Any, curve: Curve, quantity: Callable[[EvalScores], tuple[float, float, float]]
) -> None:
    from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

    xs = list(curve.points)
    middle, low, high = zip(*map(quantity, curve.points.values()), strict=True)
    axes.plot(xs, middle, curve.style, color=curve.colour, label=curve.label)
    if len(xs) == 1:  # an error bar instead of a band
        axes.plot(xs * 2, [low[0], high[0]], color=curve.colour, linewidth=1)
    else:
        axes.fill_between(xs, low, high, color=curve.colour, alpha=0.15, linewidth=0)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))  # for less than a decade
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _gain(errors: Mapping[str, float | None], unit: str = "") -> float | None:
    """How many times smaller the model's error is than that of repeating the last row."""
    model, repeat = errors[f"model{unit}"], errors[f"repeat{unit}"]
    return None if not model or repeat is None else repeat / model


#: Column -> its value in egovcp-train's report of one task; None if the episodes do not have it.
HELDOUT: Final[Mapping[str, Callable[[Mapping[str, Any]], float | None]]] = {
    "moving, 4 ahead (x)": lambda task: _gain(task["depth"]["moving"]["4"], "_mm"),
    "moving, 8 (x)": lambda task: _gain(task["depth"]["moving"]["8"], "_mm"),
    "near, 8 (x)": lambda task: _gain(task["depth"]["near"]["8"], "_mm"),
    "all pixels, 8 (x)": lambda task: _gain(task["depth"]["valid"]["8"], "_mm"),
    "joints, 4 (x)": lambda task: _gain(task["state"]["joint_position"]["4"]),
    "AUC within 5": lambda task: task["termination"]["5"]["auc"],
    "Q R2": lambda task: task["value"]["r2"],
    "Q slope": lambda task: task["value"]["slope"],
    "Q ranking": lambda task: task["value"].get("ranking"),
    "object (m)": lambda task: task.get("object_rmse_m"),
    "z active": lambda task: task["latent"]["active"],
    "KL (nats)": lambda task: task["latent"]["kl_nats"],
}
#: What `over_seeds` prints.
OVER_SEEDS: Final = "several seeds: mean and half of the range"


def heldout(records: Records, cells: Iterable[str], task: str) -> dict[str, list[float]]:
    """Column -> its values in the trainings, one per seed; empty without results, or if no episode
    of the task is held out."""
    found = [records[cell]["metrics"]["tasks"] for cell in cells if cell in records]
    runs = [tasks[task] for tasks in found if task in tasks]
    values = {name: [column(run) for run in runs] for name, column in HELDOUT.items() if runs}
    return {name: [v for v in column if v is not None] for name, column in values.items()}


def over_seeds(values: Sequence[float]) -> str:
    """One value, or mean and half of the range of several."""
    if not values:
        return "-"
    text = f"{sum(values) / len(values):.3g}"
    return text if len(values) == 1 else f"{text} ± {(max(values) - min(values)) / 2:.2g}"
