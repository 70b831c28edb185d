"""Results of cells as a Markdown table per task; several seeds as mean and half of their range."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

type Result = Mapping[str, Any]
type Column = Callable[[Mapping[str, Any]], float | None]


def _depth(region: str, k: int) -> Column:
    """How many times smaller the error is than that of the last image repeated."""
    return lambda task: _gain(task["depth"][region][str(k)], "model_mm", "repeat_mm")


def _state(group: str, k: int) -> Column:
    return lambda task: _gain(task["state"][group][str(k)], "model", "repeat")


def _gain(errors: Mapping[str, float | None], model: str, repeat: str) -> float | None:
    ours, theirs = errors[model], errors[repeat]
    return None if not ours or theirs is None else theirs / ours


_TRAINING: Mapping[str, Column] = {
    "ball, 4 ahead (x)": _depth("ball_watched", 4),
    "ball, 8 (x)": _depth("ball_watched", 8),
    "near, 8 (x)": _depth("near", 8),
    "all pixels, 8 (x)": _depth("valid", 8),
    "joints, 4 (x)": _state("joint_position", 4),
    "AUC within 5": lambda task: task["termination"]["5"]["auc"],
    "Q R2": lambda task: task["value"]["r2"],
    "Q slope": lambda task: task["value"]["slope"],
    "z active": lambda task: task["latent"]["active"],
    "KL (nats)": lambda task: task["latent"]["kl_nats"],
}
_PLANNER: Mapping[str, Column] = {
    "success": lambda task: task["success_rate"],
    "from": lambda task: task["success_ci95"][0],
    "to": lambda task: task["success_ci95"][1],
    "reward": lambda task: task["reward_mean"],
    "plan (ms)": lambda task: task["plan_ms_p50"],
}
COLUMNS = {"training": _TRAINING, "planner": _PLANNER}


def markdown(kind: str, results: Sequence[Result], command: str) -> str:
    """The tables, and the command that made them.

    Args:
        kind: training or planner.
        results: what `ablations.py` keeps of each cell and seed.
    """
    tasks = sorted({task for result in results for task in result["tasks"]})
    blocks = [f"    {command}"]
    for task in tasks:
        cells: dict[str, list[Result]] = {}
        for result in results:
            if task in result["tasks"]:
                cells.setdefault(result["cell"], []).append(result)
        rows = [_row(kind, task, same) for same in cells.values()]
        head = ["cell", "changed", *COLUMNS[kind]]
        lines = [_line(head), _line(["---"] * len(head)), *map(_line, rows)]
        blocks.append("\n".join([f"**{task}**", "", *lines]))
    return "\n\n".join(blocks) + "\n"


def _row(kind: str, task: str, same: Sequence[Result]) -> list[str]:
    flags = " ".join(flag.removeprefix("--") for flag in same[0]["flags"])
    columns = COLUMNS[kind].values()
    numbers = [[column(result["tasks"][task]) for result in same] for column in columns]
    return [same[0]["cell"], f"`{flags}`" if flags else "", *map(_shown, numbers)]


def _shown(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    text = f"{sum(known) / len(known):.3g}"
    return text if len(known) == 1 else f"{text} ± {(max(known) - min(known)) / 2:.2g}"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
