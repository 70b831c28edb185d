"""The contact tasks: ball, wall and arch."""

from __future__ import annotations

from typing import Final

from egovcp.sim.config import EnvConfig
from egovcp.sim.robot import SimulatedRobot
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.arch import ArchTask
from egovcp.sim.tasks.ball import BallTask
from egovcp.sim.tasks.base import Task
from egovcp.sim.tasks.wall import WallTask

_TASKS: Final[dict[str, type[Task]]] = {"ball": BallTask, "wall": WallTask, "arch": ArchTask}


def make_task(config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> Task:
    """The task of ``scenario``; draws its geometry and writes it into the robot's model."""
    return _TASKS[scenario.task](config, scenario, robot)
