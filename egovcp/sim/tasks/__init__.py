"""Contact tasks: the base class of tasks, how they are found, and those that egovcp ships."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from egovcp.bounds import bounded
from egovcp.sim.tasks.options import EpisodeConfig, Range, TaskConfig
from egovcp.sim.tasks.registry import find_task, register_task, task_entries, task_names

if TYPE_CHECKING:
    from egovcp.robot_spec import Mirror, RobotSpec
    from egovcp.sim.mujoco_robot import MujocoRobot
    from egovcp.sim.scene import HANDS, HEAD, LEG, PARTS, TORSO, Contact
    from egovcp.sim.tasks.base import Array, Task
    from egovcp.sim.tasks.base_task import BaseTask
    from egovcp.sim.tasks.robot_task import RobotTask
    from egovcp.spec import ActionBox, Solid

__all__ = [
    "HANDS",
    "HEAD",
    "LEG",
    "PARTS",
    "TORSO",
    "ActionBox",
    "Array",
    "BaseTask",
    "Contact",
    "EpisodeConfig",
    "Mirror",
    "MujocoRobot",
    "Range",
    "RobotSpec",
    "RobotTask",
    "Solid",
    "Task",
    "TaskConfig",
    "bounded",
    "find_task",
    "register_task",
    "task_entries",
    "task_names",
]

#: Imported on first use, because it needs MuJoCo; a robot has options without the simulator.
_MODULES = {
    **dict.fromkeys(("HANDS", "HEAD", "LEG", "PARTS", "TORSO", "Contact"), "egovcp.sim.scene"),
    **dict.fromkeys(("Array", "Task"), "egovcp.sim.tasks.base"),
    **dict.fromkeys(("Mirror", "RobotSpec"), "egovcp.robot_spec"),
    **dict.fromkeys(("ActionBox", "Solid"), "egovcp.spec"),
    "BaseTask": "egovcp.sim.tasks.base_task",
    "MujocoRobot": "egovcp.sim.mujoco_robot",
    "RobotTask": "egovcp.sim.tasks.robot_task",
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
