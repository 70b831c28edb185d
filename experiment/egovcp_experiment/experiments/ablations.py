"""Held-out metrics of world models with single choices changed.

One model per choice, with equal steps and seeds, on the data of all tasks together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from egovcp.errors import UsageError
from egovcp_experiment import results
from egovcp_experiment.cell import Flags
from egovcp_experiment.experiments.table1 import MODELS
from egovcp_experiment.grid import DEFAULT, Grid, Model
from egovcp_experiment.report import ExperimentReport, Plot, Table, draw

type Rows = Mapping[str, Mapping[str, Sequence[float]]]
"""Choice -> column -> values of the trainings."""

#: Ablations that are presets of egovcp-train.
_PRESETS: Final = (
    "paper", "kl_equal", "kl_tenfold", "no_free_nats", "free_nats_per_dimension", "pixels_summed",
    "state_summed", "state_1", "no_motion_weight", "no_proximity_weight",
    "value_weight_1", "no_imagined_value", "no_object", "monte_carlo", "no_sampled_actions",
)  # fmt: skip
#: Choice -> changed flags of egovcp-train; those of `table1` share its trainings.
CHOICES: Final[dict[str, Flags]] = {
    **MODELS,
    **{name: {"preset": name} for name in _PRESETS},
    "raw_returns": {"returns.scale": "none"},
    "value_two_hot": {"policy.value_loss": "two_hot"},
    "no_reward_head": {"policy.loss.reward": 0},
    "short_windows": {"sampling.length": 16, "batch_size": 80},  # as many rows per step
}


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    """Request the cells of all choices; report those in ``records``.

    Raises:
        UsageError: a preset is given, which those of the choices would replace.
    """
    config = grid.config
    if config.train.preset != "default" and config.scale != "smoke":
        raise UsageError(
            f"--train.preset={config.train.preset}: ablations choose presets themselves; drop it"
        )
    trained_on = grid.trained_on
    trainings = {
        name: [
            grid.train(
                trained_on,
                seed,
                Model(name, flags),
                "" if name in MODELS else f"ablate-{trained_on}-{name}-s{seed}",
            ).name
            for seed in config.train.seeds
        ]
        for name, flags in config.chosen(CHOICES).items()
    }
    page = ExperimentReport(
        "Ablations: effect of each design choice on held-out metrics",
        note="",  # plays no scenarios
        sections=[
            f"Every model was trained for {config.train.steps} gradient steps on the "
            "data of all tasks named here together, and differs from `default` in the flags named. "
            "(x): how many times smaller the error is than that of repeating the last image, at "
            "that many ticks open-loop. Columns of Q compare it with each model's own target: the "
            "critic, but returns for `mc`, `monte_carlo`, `td` and `paper` (whose returns differ, "
            "too). So they are not comparable between these groups."
        ],
    )
    found: dict[str, Rows] = {}
    for task in config.tasks:
        rows = {
            name: row
            for name, cells in trainings.items()
            if (row := results.heldout(records, cells, task))
        }
        page.lead += _best(task, rows, "moving, 8 (x)")
        page.findings += _best(task, rows, "all pixels, 8 (x)")
        if not rows and any(cell in records for cells in trainings.values() for cell in cells):
            page.findings.append(f"{task}: no episode is held out, because its data has too few.")
        page.sections.append(_table(task, rows))
        page.metrics[task] = rows
        found[task] = rows
    page.plot = _plot(found, "moving, 8 (x)")
    return page


def _means(rows: Rows, column: str) -> dict[str, float]:
    return {n: sum(row[column]) / len(row[column]) for n, row in rows.items() if row[column]}


def _best(task: str, rows: Rows, column: str) -> list[str]:
    """The best choice by a column, and the rank of the default."""
    means = _means(rows, column)
    if len(means) < 2 or DEFAULT not in means:
        return []
    best = max(means, key=means.__getitem__)
    rank = 1 + sum(value > means[DEFAULT] for value in means.values())
    return [
        f"{task}, {column}: `{best}` is best with {means[best]:.3g}; `default` has "
        f"{means[DEFAULT]:.3g}, place {rank} of {len(means)}."
    ]


def _plot(found: Mapping[str, Rows], column: str) -> Plot | None:
    """A column of all choices: the mean over trainings, for each task."""
    means = {task: _means(rows, column) for task, rows in found.items()}
    names = list(dict.fromkeys(name for row in means.values() for name in row))
    if not names:
        return None

    def paint(figure: Any) -> None:
        axes = figure.subplots()
        for task, row in means.items():
            axes.plot(list(row.values()), [names.index(n) for n in row], "o", label=task)
        axes.set_yticks(range(len(names)), names)
        axes.invert_yaxis()
        axes.set_xlabel(column)
        axes.legend(fontsize=8)

    caption = f"{column}: how many times smaller the error is than that of repeating the last image"
    return draw("choices", caption, paint, (8.0, 0.9 + 0.25 * len(names)))


def _table(task: str, rows: Rows) -> Table:
    def changed(name: str) -> str:
        text = " ".join(f"{flag}={value}" for flag, value in CHOICES[name].items())
        return f"`{text}`" if text else ""

    return Table(
        f"{task} ({results.OVER_SEEDS})",
        ("choice", "changed", *results.HELDOUT),
        [
            (name, changed(name), *map(results.over_seeds, row.values()))
            for name, row in rows.items()
        ],
    )
