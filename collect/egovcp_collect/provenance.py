"""Provenance of a collection: what is recorded, its migration, and the comparison for --resume."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from typing import Any, Final

import draccus

from egovcp.data import Provenance
from egovcp.errors import UsageError
from egovcp.flags import merged
from egovcp.packages import versions_of
from egovcp.sim.robot_env import controller_id_of
from egovcp.sim.tasks.registry import ALL_TASKS
from egovcp.values import differences
from egovcp_collect.config import EPISODE_OPTIONS, CollectConfig

_PACKAGES: Final = ("egovcp", "mujoco", "mjlab", "numpy")  # which determine the data
_SHOWN_DIFFERENCES: Final = 5


def make_provenance(config: CollectConfig, command: str) -> Provenance:
    """What ``meta/collection.json`` records of a collection."""
    settings = draccus.encode(config)
    return Provenance(
        controller_id=controller_id_of(config.env, config.tasks),
        seed=config.seed,
        command=command,
        # Python is recorded for information only: `require_compatible` does not compare it.
        versions={"python": platform.python_version(), **versions_of(_PACKAGES)},
        config={
            **{name: settings[name] for name in EPISODE_OPTIONS},
            "task": ",".join(config.tasks),  # what `all` means depends on what is installed
            "mix": {task: config.mix[task] for task in config.tasks if task in config.mix},
        },
        origin="simulated",
    )


def _migrated(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Recorded `EPISODE_OPTIONS`, with options that are newer than the record filled in, and
    without those of tasks that are neither used nor installed."""
    defaults = draccus.encode(CollectConfig())
    config = merged({name: defaults[name] for name in EPISODE_OPTIONS}, recorded)
    if config["task"] == ALL_TASKS:  # of earlier versions, whose mix has all tasks
        config["task"] = ",".join(task for task, weight in config["mix"].items() if weight)
    used = config["task"].split(",")
    weights = config["mix"].items()
    config["mix"] = {task: weight for task, weight in weights if task in used and weight != 1.0}
    env = config["env"]
    for task in [name for name in env if f"{name}_episode" in env]:
        if task not in used and task not in defaults["env"]:
            del env[task], env[f"{task}_episode"]
    return config


def require_compatible(now: Provenance, before: Provenance) -> None:
    """Raise `UsageError` unless both collections have the same settings and package versions."""
    if before.seed is None:  # `egovcp-collect` always records one
        raise UsageError(
            "--resume continues a dataset that egovcp-collect began, and this one was merged or "
            "converted; collect into another --dataset.root, then join both with "
            "`egovcp-dataset merge`"
        )
    # Python, and LeRobot in older records, do not determine the data.
    before_versions, now_versions = (
        {name: p.versions.get(name) for name in _PACKAGES} for p in (before, now)
    )
    settings = {
        "--seed": (before.seed, now.seed),
        "low-level controller": (before.controller_id, now.controller_id),
        **dict(differences(before_versions, now_versions, "version of ")),
        **dict(differences(_migrated(before.config), _migrated(now.config), "--")),
    }
    changed = [
        f"{name} was {old}, is {new}"
        for name, (old, new) in settings.items()
        # controllers are compared by id: a file of another name may hold the same one
        if name != "--env.controller" and old != new
    ]
    if changed:
        omitted = len(changed) - _SHOWN_DIFFERENCES
        more = f", and {omitted} more" if omitted > 0 else ""
        raise UsageError(
            "--resume would add episodes that were made differently: "
            f"{'; '.join(changed[:_SHOWN_DIFFERENCES])}{more}; use the settings and package "
            "versions of the dataset, or another --dataset.root"
        )
