"""Public conformance checks of datasets, environments, robots, tasks, world models and policies.

Each raises an `EgovcpError` that names the problem and its place.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from egovcp.errors import ConformanceError

if TYPE_CHECKING:
    from egovcp.checks.dataset import check_dataset
    from egovcp.checks.environment import check_env
    from egovcp.checks.robot import RobotReport, check_robot
    from egovcp.checks.task import TaskReport, check_task
    from egovcp.checks.world_model import check_artifact, check_world_model

__all__ = [
    "ConformanceError",
    "RobotReport",
    "TaskReport",
    "check_artifact",
    "check_dataset",
    "check_env",
    "check_robot",
    "check_task",
    "check_world_model",
]

#: Imported on first use: a check of a dataset does not import torch.
_MODULES = {
    "RobotReport": "robot",
    "TaskReport": "task",
    "check_artifact": "world_model",
    "check_dataset": "dataset",
    "check_env": "environment",
    "check_robot": "robot",
    "check_task": "task",
    "check_world_model": "world_model",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
