"""The contact tasks: ball, wall and arch, and several of them in one episode."""

from __future__ import annotations

from typing import Final

from egovcp.sim.config import EnvConfig
from egovcp.sim.robot import SimulatedRobot
from egovcp.sim.scenario import SEQUENCE, Scenario
from egovcp.sim.tasks.base import Task
from egovcp.sim.tasks.sequence import SINGLE, SequenceTask

_TASKS: Final[dict[str, type[Task]]] = {**SINGLE, SEQUENCE: SequenceTask}


def make_task(config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> Task:
    """The task of ``scenario``; samples its geometry and writes it into the robot's model."""
    return _TASKS[scenario.task](config, scenario, robot)
