"""The tables of a dataset card, as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

from egovcp.help_text import field_docs
from egovcp.sim.config import BaseEnvConfig, EnvConfig
from egovcp_collect.dataset.statistics import TaskStatistics


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; pipes in cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(
        f"| {' | '.join(str(cell).replace('|', r'\|') for cell in line)} |" for line in lines
    )


def settings_tables(config: Mapping[str, Any], tasks: Sequence[str]) -> tuple[str, str]:
    """Parameters drawn per episode, and constant ones, of a recorded configuration."""
    drawn, constant = [], []
    for name, value, meaning in _settings(config.get("env", {}), tasks):
        if isinstance(value, list) and len(value) == 2:  # a range
            low, high = value
            if low != high:
                drawn.append((f"`env.{name}`", _format(low), _format(high), meaning))
                continue
            value = low
        constant.append((f"`env.{name}`", _format(value), meaning))
    head = ("parameter", "from", "to", "meaning")
    return markdown_table(head, drawn), markdown_table(("parameter", "value", "meaning"), constant)


def _settings(env: Mapping[str, Any], tasks: Sequence[str]) -> Iterator[tuple[str, Any, str]]:
    """Dotted name, value and documentation of the settings of these tasks.

    Options unknown to this version get an empty description.
    """
    defaults, docs = EnvConfig(), dict(field_docs(EnvConfig))
    general = {option.name for option in fields(BaseEnvConfig)}
    for group, value in env.items():
        own = group in general or group.removesuffix("_episode") in tasks
        if group == "threads" or (isinstance(value, Mapping) and not own):
            continue
        if not isinstance(value, Mapping):
            yield group, value, docs.get(group, "")
            continue
        kind = type(getattr(defaults, group, None))
        group_docs = dict(field_docs(kind)) if is_dataclass(kind) else {}
        for name, setting in value.items():
            yield f"{group}.{name}", setting, group_docs.get(name, "")


def _format(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return ", ".join(map(_format, value)) if isinstance(value, list) else str(value)


def coverage_table(tasks: Sequence[TaskStatistics]) -> str:
    """Statistics, one column per task."""
    columns = [coverage_column(task) for task in tasks]
    rows = [(name, *(column[name] for column in columns)) for name in columns[0]]
    return markdown_table(("", *(task.task for task in tasks)), rows)


def coverage_column(task: TaskStatistics) -> dict[str, str]:
    """Statistics of one task: name -> text."""
    r, d, length = task.returns, task.depth, task.length
    return {
        "episodes": f"{task.episodes}",
        "steps": f"{task.steps} ({task.step_share:.0%})",
        "ticks per episode": f"{length.low:.0f} to {length.high:.0f}" if length else "none",
        "episodes that succeed": f"{task.success_share:.1%}",
        "episodes that end in a fall": f"{task.fall_share:.1%}",
        f"return (gamma {r.gamma:g}, {r.steps} ticks), mean and std": (
            f"{r.spread.mean:.3f}, {r.spread.std:.3f}" if r.spread else "none"
        ),
        "return, 5 % to 95 %": f"{r.spread.q05:.3f} to {r.spread.q95:.3f}" if r.spread else "none",
        "frames with a reward event within the return horizon": f"{r.positive_share:.1%}",
        "frames with a cost event within the return horizon": f"{r.negative_share:.1%}",
        "visited cells of the hand workspace": ", ".join(
            f"{hand} {share:.0%}" for hand, share in task.action.occupied.items()
        ),
        "depth pixels measured, nearer than 1 m": f"{d.valid_share:.0%}, {d.near_share:.1%}",
    }


def event_table(tasks: Sequence[TaskStatistics]) -> str:
    """Rate of each reward term."""
    rows = [
        (task.task, f"`{name}`", f"{rate.per_1000_steps:.2f}", f"{rate.episode_share:.1%}")
        for task in tasks
        for name, rate in task.events.items()
    ]
    return markdown_table(("task", "term", "ticks per 1000 steps", "episodes"), rows)
