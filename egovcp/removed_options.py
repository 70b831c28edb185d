"""Options of older versions that were removed or renamed, and what replaces them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from egovcp.errors import UsageError

_TRACKER: Final = (
    "the ball tracker was removed and the world model learns from depth images alone: leave it out"
)
_HEADS: Final = "Q has one head, which reads the whole state: leave it out"

#: Option, or group of options -> one sentence.
REMOVED_OPTIONS: Final[Mapping[str, str]] = {
    # egovcp-train
    "value_fit": (
        "Q is trained with the world model and not fitted again afterwards: leave it out"
    ),
    "passing": _TRACKER,
    "policy.motion_ahead": _TRACKER,
    "policy.paint_flight": _TRACKER,
    "policy.value_of_passing": _TRACKER,
    "policy.flight": _TRACKER,
    "policy.loss.flight": _TRACKER,
    "policy.loss.motion": _TRACKER,
    "policy.loss.passing": _TRACKER,
    "policy.loss.foresight_motion": _TRACKER,
    "policy.value_state": _HEADS,
    "policy.q_heads": _HEADS,
    "policy.value_units": "the head of Q is as wide as every MLP: use --policy.units",
    "planner.ensemble": _HEADS,
    "sampling.event_fraction": (
        "windows are drawn uniformly: leave it out; --sampling.tasks weights whole tasks"
    ),
    "datasets.return_steps": "all datasets have one horizon of returns: use --returns.steps",
    # egovcp-experiment
    "train.task_flags": "all tasks share one recipe: use --train.flags",
    "play.task_flags": "all tasks share one recipe: use --play.flags",
    # egovcp-eval-model
    "return_steps": "Q is compared with the returns that it was trained on: leave it out",
}
#: Option of older versions -> its present name.
RENAMED_OPTIONS: Final[Mapping[str, str]] = {
    "policy.loss.moving": "policy.loss.motion_weight",
    "policy.loss.moving_threshold": "policy.loss.motion_threshold",
    "policy.loss.near": "policy.loss.proximity_weight",
    "policy.loss.near_threshold": "policy.loss.proximity_threshold",
    "policy.loss.foresight_depth": "policy.loss.multistep_depth",
    "policy.loss.foresight_state": "policy.loss.multistep_state",
    "policy.loss.foresight_ahead": "policy.loss.multistep_horizons",
    "policy.loss.foresight_every": "policy.loss.multistep_stride",
    "planner.process": "planner.action_parameterization",
    "robot.limits.picture_hold_s": "robot.limits.image_hold_s",
}
_INDEX: Final = re.compile(r"\[\d+\]")


class RemovedOptionError(UsageError):
    """An option of older versions."""


def refuse_removed_flag(flag: str) -> None:
    """Raise `RemovedOptionError` if an unknown flag, such as ``--policy.x``, was removed."""
    if reason := _reason(flag.removeprefix("--")):
        raise RemovedOptionError(f"option {flag} was removed: {reason}")


def refuse_preset_flag(flag: str) -> None:
    """Raise `RemovedOptionError` for an option that only a configuration can set."""
    raise RemovedOptionError(
        f"option {flag} was removed from the command line: it is a constant of --preset; set it in "
        "a file, --config_path, or in Python"
    )


def refuse_removed_options(options: Mapping[str, Any], file: str) -> None:
    """Raise `RemovedOptionError`, which names all removed options of a configuration file.

    Args:
        options: the content of the file, nested by group.
        file: its name, for the message.
    """
    found: dict[str, list[str]] = {}
    for name, reason in _removed(options, ""):
        found.setdefault(reason, []).append(name)
    if found:
        listed = "; ".join(f"{', '.join(names)} ({reason})" for reason, names in found.items())
        raise RemovedOptionError(f"{file} has options that were removed: {listed}")


def _removed(value: object, name: str) -> Iterator[tuple[str, str]]:
    """Name and reason of every removed option within a value."""
    if reason := _reason(name):
        yield name, reason
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _removed(item, f"{name}.{key}" if name else str(key))
    elif isinstance(value, Sequence) and not isinstance(value, str):
        for index, item in enumerate(value):
            yield from _removed(item, f"{name}[{index}]")


def _reason(name: str) -> str | None:
    """The reason of ``group.option``, or of the removed group that contains it."""
    parts = _INDEX.sub("", name).split(".")
    prefixes = (".".join(parts[:end]) for end in range(1, len(parts) + 1))
    known = dict(REMOVED_OPTIONS) | {
        old: f"its name is now {new}" for old, new in RENAMED_OPTIONS.items()
    }
    return next((known[p] for p in prefixes if p in known), None)
