"""What a model does on held-out episodes, as columns of a table.

A run is what `egovcp-train` reports of one task: ``figures.tasks.TASK`` of its cell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

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
    "ball, 4 ahead (x)": lambda task: _depth(task, "ball_watched", 4),
    "ball, 8 (x)": lambda task: _depth(task, "ball_watched", 8),
    "near, 8 (x)": lambda task: _depth(task, "near", 8),
    "all pixels, 8 (x)": lambda task: _depth(task, "valid", 8),
    "joints, 4 (x)": lambda task: _gain(task["state"]["joint_position"]["4"], "model", "repeat"),
    "AUC within 5": lambda task: task["termination"]["5"]["auc"],
    "Q R2": lambda task: task["value"]["r2"],
    "Q slope": lambda task: task["value"]["slope"],
    "z active": lambda task: task["latent"]["active"],
    "KL (nats)": lambda task: task["latent"]["kl_nats"],
}


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
