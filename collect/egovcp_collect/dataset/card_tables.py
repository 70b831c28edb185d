"""The tables of a dataset card, as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import is_dataclass
from typing import Any, Final

from egovcp import spec
from egovcp.data import schema
from egovcp.help_text import field_docs
from egovcp.sim.config import EnvConfig
from egovcp_collect.dataset.statistics import TaskStatistics

_FEATURES: Final = {
    spec.DEPTH_KEY: "planar depth (along the optical axis) of the head camera, mm; 0: not measured",
    spec.STATE_KEY: "proprioception and the last command, see below",
    spec.ACTION_KEY: "targets for hands and pelvis height, normalised, see below",
    spec.REWARD_KEY: "reward after the action",
    spec.DONE_KEY: "the episode ended with this row, by a fall or at its time limit",
    spec.SUCCESS_KEY: "the task is achieved after the action",
    spec.TRUNCATED_KEY: "the episode ended with this row at its time limit",
    "timestamp": "s since the start of the episode",
    "frame_index": "row within the episode",
    "episode_index": "episode within the dataset",
    "index": "row within the dataset",
    "task_index": "row of `meta/tasks.parquet`",
}
#: Part of the state -> content, unit, frame.
_STATE: Final = {
    "angular_velocity": ("angular velocity x, y, z", "rad/s", "pelvis IMU"),
    "projected_gravity": (
        "direction of gravity; upright is (0, 0, -1)",
        "1 (unit vector)",
        "pelvis IMU",
    ),
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
        f"| {' | '.join(str(cell).replace('|', r'\|') for cell in line)} |" for line in lines
    )


def feature_table() -> str:
    """Every column of the dataset."""
    rows = [
        (
            f"`{key}`",
            "image, uint16" if feature["dtype"] == "image" else feature["dtype"],
            feature["shape"],
            _FEATURES[key],
        )
        for key, feature in schema.FEATURES.items()
    ]
    return markdown_table(("feature", "type", "shape", "content"), rows)


def state_table() -> str:
    """Content, unit and frame of each part of the state."""
    rows = [
        (f"{part.start}:{part.stop}", *_STATE[name]) for name, part in spec.STATE_SLICES.items()
    ]
    return markdown_table(("index", "content", "unit", "frame"), rows)


def action_table() -> str:
    """Metres that correspond to -1, 0 and 1 of each action."""
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
    others = {task for task in spec.TASKS if task not in tasks}
    defaults, docs = EnvConfig(), dict(field_docs(EnvConfig))
    for group, value in env.items():
        if group.removesuffix("_episode") in others or group == "threads":
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
    columns = [_coverage_column(task) for task in tasks]
    rows = [(name, *(column[name] for column in columns)) for name in columns[0]]
    return markdown_table(("", *(task.task for task in tasks)), rows)


def _coverage_column(task: TaskStatistics) -> dict[str, str]:
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
