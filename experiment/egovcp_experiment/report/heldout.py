"""What a model does on held-out episodes, as columns of a table.

A run is what `egovcp-train` reports of one task: ``figures.tasks.TASK`` of its cell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from egovcp_experiment.report.document import Table
from egovcp_experiment.store import Record

#: A column of the table, of one run; none where its episodes do not show it.
type Column = Callable[[Mapping[str, Any]], float | None]

#: What `over_seeds` prints.
OVER_SEEDS: Final = "several seeds: mean and half of the range"


def _depth(task: Mapping[str, Any], region: str, k: int) -> float | None:
    """How many times smaller the error is than that of the last image repeated."""
    return _gain(task["depth"][region][str(k)], "model_mm", "repeat_mm")


def _gain(errors: Mapping[str, float | None], model: str, repeat: str) -> float | None:
    ours, theirs = errors[model], errors[repeat]
    return None if not ours or theirs is None else theirs / ours


COLUMNS: Final[Mapping[str, Column]] = {
    "moving, 4 ahead (x)": lambda task: _depth(task, "moving", 4),
    "moving, 8 (x)": lambda task: _depth(task, "moving", 8),
    "near, 8 (x)": lambda task: _depth(task, "near", 8),
    "all pixels, 8 (x)": lambda task: _depth(task, "valid", 8),
    "joints, 4 (x)": lambda task: _gain(task["state"]["joint_position"]["4"], "model", "repeat"),
    "AUC within 5": lambda task: task["termination"]["5"]["auc"],
    "Q R2": lambda task: task["value"]["r2"],
    "Q slope": lambda task: task["value"]["slope"],
    "z active": lambda task: task["latent"]["active"],
    "KL (nats)": lambda task: task["latent"]["kl_nats"],
}


#: Without the latent's, whose KL not every kind of model learns.
_SHARED: Final = {n: c for n, c in COLUMNS.items() if n not in ("z active", "KL (nats)")}

#: Task -> what a model is called -> column -> its value of each seed.
type Models = dict[str, dict[str, dict[str, list[float]]]]


def add(
    models: Models, task: str, name: str, cells: Iterable[str], records: Mapping[str, Record]
) -> None:
    """Add what the trainings of a model, one for each seed, found, as far as they are there."""
    runs = [records[cell]["figures"]["tasks"][task] for cell in cells if cell in records]
    if runs:
        models.setdefault(task, {})[name] = measured(runs, _SHARED)


def models_table(models: Models, where: str = "held-out episodes") -> Table:
    """All of them beside each other, measured on what ``where`` says."""
    return Table(
        title=(
            f"The models on {where}; (x): times below the error of the last image "
            "repeated, so many ticks ahead; Q beside Monte Carlo returns, whatever it learns from "
            f"({OVER_SEEDS})"
        ),
        head=("task", "model", *_SHARED),
        rows=tuple(
            (task, name, *(over_seeds(values) for values in row.values()))
            for task, rows in models.items()
            for name, row in rows.items()
        ),
    )


def measured(
    runs: Sequence[Mapping[str, Any]], columns: Mapping[str, Column] = COLUMNS
) -> dict[str, list[float]]:
    """Column -> its value of each run that has one."""
    values = {name: [column(run) for run in runs] for name, column in columns.items()}
    return {name: [v for v in column if v is not None] for name, column in values.items()}


def over_seeds(values: Sequence[float]) -> str:
    """One value as it is, several as their mean and half of their range."""
    if not values:
        return "-"
    text = f"{sum(values) / len(values):.3g}"
    return text if len(values) == 1 else f"{text} ± {(max(values) - min(values)) / 2:.2g}"
