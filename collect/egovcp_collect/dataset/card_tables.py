"""The tables of a dataset card, as Markdown."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from functools import cache
from itertools import pairwise
from typing import Any, Final

from egovcp import spec
from egovcp.data import schema
from egovcp.sim.config import EnvConfig
from egovcp_collect.dataset.survey import TaskSurvey

_FEATURES: Final = {
    spec.DEPTH_KEY: "planar depth (along the optical axis) of the head camera, mm; 0: not measured",
    spec.STATE_KEY: "proprioception and the last command, see below",
    spec.ACTION_KEY: "targets for hands and pelvis height, normalised, see below",
    spec.REWARD_KEY: "reward after the action",
    spec.DONE_KEY: "the episode ended with this row, by a fall or by its time limit",
    spec.SUCCESS_KEY: "the task is achieved after the action",
    spec.TRUNCATED_KEY: "the episode ended with this row because its time was up",
    "timestamp": "s since the start of the episode",
    "frame_index": "row within the episode",
    "episode_index": "episode within the dataset",
    "index": "row within the dataset",
    "task_index": "row of `meta/tasks.parquet`",
}
#: Part of the state -> what it is, unit, frame.
_STATE: Final = {
    "angular_velocity": ("angular velocity x, y, z", "rad/s", "pelvis IMU"),
    "projected_gravity": ("direction of gravity; upright is (0, 0, -1)", "unit", "pelvis IMU"),
    "command_velocity": ("commanded vx, vy and yaw rate", "m/s, rad/s", "pelvis heading"),
    "command_hands": ("hand targets sent last, left xyz, right xyz", "m", "pelvis heading"),
    "command_height": ("pelvis height sent last", "m", "above ground"),
    "joint_position": ("29 joint angles in the order of the feature's names", "rad", "joint"),
    "joint_velocity": ("29 joint velocities", "rad/s", "joint"),
}


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; pipes in cells are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(
        f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in line)} |"
        for line in lines
    )


def feature_table() -> str:
    """Every column of the dataset."""
    rows = [
        (f"`{key}`", _kind(feature), feature["shape"], _FEATURES[key])
        for key, feature in schema.FEATURES.items()
    ]
    return markdown_table(("feature", "type", "shape", "content"), rows)


def _kind(feature: Mapping[str, Any]) -> str:
    return "image, uint16" if feature["dtype"] == "image" else str(feature["dtype"])


def state_table() -> str:
    """What each of the state's values is."""
    rows = [
        (f"{part.start}:{part.stop}", *_STATE[name]) for name, part in spec.STATE_SLICES.items()
    ]
    return markdown_table(("index", "content", "unit", "frame"), rows)


def action_table() -> str:
    """What -1, 0 and 1 of each action are in metres."""
    box = spec.ACTION_BOX
    rows = [
        (
            f"`{name}`",
            *(f"{v:.2f} m" for v in (box.low[i], box.neutral[i], box.high[i])),
            "above ground" if name == "height" else "pelvis heading",
        )
        for i, name in enumerate(spec.ACTION_NAMES)
    ]
    return markdown_table(("action", "-1", "0", "1", "frame"), rows)


def settings_tables(config: Mapping[str, Any], tasks: Sequence[str]) -> tuple[str, str]:
    """What was drawn per episode, and what was constant, of a recorded configuration."""
    env = config.get("env", {})
    drawn, constant = [], []
    for name, value in _settings(env, tasks):
        meaning = _meaning(name)
        if _is_range(value):
            low, high = value
            if low != high:
                drawn.append((f"`env.{name}`", _plain(low), _plain(high), meaning))
                continue
            value = low
        constant.append((f"`env.{name}`", _plain(value), meaning))
    head = ("parameter", "from", "to", "meaning")
    return markdown_table(head, drawn), markdown_table(("parameter", "value", "meaning"), constant)


def _settings(env: Mapping[str, Any], tasks: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """Dotted name and value of what concerns these tasks."""
    others = {task for task in spec.TASKS if task not in tasks}
    for part, value in env.items():
        if part.removesuffix("_episode") in others or part == "threads":
            continue
        if isinstance(value, Mapping):
            yield from ((f"{part}.{name}", setting) for name, setting in value.items())
        else:
            yield part, value


def _is_range(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2


def _plain(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return ", ".join(map(_plain, value)) if isinstance(value, list) else str(value)


def _meaning(name: str) -> str:
    """The configuration's own words; empty for what this version does not know."""
    owner: Any = EnvConfig()
    *parts, last = name.split(".")
    for part in parts:
        owner = getattr(owner, part, None)
    if not is_dataclass(owner):
        return ""
    kind: type = type(owner)
    return field_docs(kind).get(last, "")


@cache
def field_docs(config_class: type) -> Mapping[str, str]:
    """Field -> the docstring beneath it, on one line."""
    body = ast.parse(inspect.getsource(config_class)).body[0]
    assert isinstance(body, ast.ClassDef), "the source of a class is a class"
    docs = {}
    for statement, below in pairwise(body.body):
        if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
            text = below.value if isinstance(below, ast.Expr) else None
            if isinstance(text, ast.Constant) and isinstance(text.value, str):
                docs[statement.target.id] = " ".join(text.value.split())
    return docs


def coverage_table(tasks: Sequence[TaskSurvey]) -> str:
    """One column of figures per task."""
    facts = [_facts(task) for task in tasks]
    rows = [(name, *(fact[name] for fact in facts)) for name in facts[0]]
    return markdown_table(("", *(task.task for task in tasks)), rows)


def _facts(task: TaskSurvey) -> dict[str, str]:
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
        "rows with a reward ahead that stands out": f"{r.positive_share:.1%}",
        "rows with a cost ahead that stands out": f"{r.negative_share:.1%}",
        "cells of the hands' box that are filled": ", ".join(
            f"{hand} {share:.0%}" for hand, share in task.action.occupied.items()
        ),
        "depth pixels measured, nearer than 1 m": f"{d.valid_share:.0%}, {d.near_share:.1%}",
    }


def event_table(tasks: Sequence[TaskSurvey]) -> str:
    """How often each reward term acted."""
    rows = [
        (task.task, f"`{name}`", f"{rate.per_1000_steps:.2f}", f"{rate.episode_share:.1%}")
        for task in tasks
        for name, rate in task.events.items()
    ]
    return markdown_table(("task", "term", "ticks per 1000 steps", "episodes"), rows)
