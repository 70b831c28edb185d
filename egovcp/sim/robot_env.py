"""Environment of robots other than the G1, and `make_env`, which chooses."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import SimulationDiverged
from egovcp.robot.controllers import make_controller
from egovcp.sim.base_env import (
    BaseInstance,
    BaseVectorEnv,
    Observation,
    StepResult,
    one_robot,
    reporting_plugin_errors,
    require_class,
)
from egovcp.sim.env import VectorEnv
from egovcp.sim.mujoco_robot import Array, MujocoRobot
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.registry import find_task
from egovcp.sim.tasks.robot_task import RobotTask

if TYPE_CHECKING:
    from egovcp.sim.config import EnvConfig


def make_env(config: EnvConfig, num_envs: int, tasks: Iterable[str]) -> BaseVectorEnv:
    """The environment of the robot of ``tasks``; see `VectorEnv` and `RobotEnv`.

    Raises:
        UsageError: the tasks are of different robots.
    """
    names = tuple(tasks)
    if one_robot(names).is_g1:
        return VectorEnv(config, num_envs)
    return RobotEnv(config, num_envs, _robot_class(names[0]))


def controller_id_of(config: EnvConfig, tasks: Iterable[str]) -> str:
    """Identity of the low-level control of the robot of ``tasks``.

    Raises:
        UsageError: the tasks are of different robots.
    """
    names = tuple(tasks)
    if one_robot(names).is_g1:
        return make_controller(config.controller).id
    return _robot_class(names[0]).control_id


def _robot_class(task: str) -> type[MujocoRobot]:
    return cast(type[RobotTask], find_task(task)).robot_class


class RobotInstance(BaseInstance):
    """One robot in one episode at a time; all randomness comes from the scenario."""

    def __init__(self, config: EnvConfig, scenario: Scenario) -> None:
        self._config = config
        self.start(scenario)

    def start(self, scenario: Scenario) -> None:
        """Begin the episode of ``scenario``."""
        self.scenario = scenario
        kind = cast(type[RobotTask], find_task(scenario.task))
        # a fresh copy, because a task may edit the model
        self.robot = kind.robot_class(copy.copy(kind.scene()))
        self.robot.reset(scenario.rng("robot"))
        self.task = kind(self._config, scenario, self.robot)
        self.task.place()
        self.robot.forward()
        self.tick = 0
        self.terminated = self.truncated = False
        self._sense()

    def advance(self, action: Array) -> None:
        """One planner tick under a normalised action (A,).

        Raises:
            SimulationDiverged: the physics is no longer valid.
        """
        if self.done:
            return
        self.task.begin_tick()
        self.robot.command(self.robot.spec.action_box.to_metric(action))
        for _ in range(self.task.physics_clock()[1]):
            self.task.step()
        if self.robot.diverged:
            raise SimulationDiverged(
                f"the simulation diverged in task {self.scenario.task}, seed {self.scenario.seed}, "
                f"episode {self.scenario.episode}, after {self.task.time:.2f} s; choose a smaller "
                "timestep, softer actuators, or narrower ranges of the task"
            )
        self.robot.forward()
        self._sense()

    def _sense(self) -> None:
        self.state = np.asarray(self.robot.state(), np.float64)
        self.depth = self.robot.depth()

    @property
    def base_pose(self) -> Array:
        """(7,) pose of the base frame in the world, m and quaternion wxyz."""
        return self.robot.base_pose


class RobotEnv(BaseVectorEnv):
    """B robots of one `MujocoRobot` class, each in its own episode of any of its tasks."""

    def __init__(self, config: EnvConfig, num_envs: int, robot: type[MujocoRobot]) -> None:
        super().__init__(config, num_envs, robot.spec)
        self._class = robot

    @property
    def controller_id(self) -> str:
        """`MujocoRobot.control_id`."""
        return self._class.control_id

    def _check(self, scenarios: Sequence[Scenario]) -> None:
        super()._check(scenarios)
        require_class(self._class, [scenario.task for scenario in scenarios])

    def _instance(self, scenario: Scenario) -> RobotInstance:
        return RobotInstance(self.config, scenario)

    @reporting_plugin_errors()
    def step(self, action: NDArray[np.floating]) -> StepResult:
        """Send one normalised action (B, A) per row and let a planner tick pass."""
        self._send(action, ~self.done)
        sent = self._sent[:, 0]
        for row, instance in enumerate(self.instances):
            instance.advance(sent[row])
        return self._result([i.end_tick(sent[row]) for row, i in enumerate(self.instances)])

    def _observe(self) -> Observation:
        state = np.array([instance.state for instance in self.instances], np.float32)
        return Observation(np.stack([instance.depth for instance in self.instances]), state)

    def _in_range(self, position: Array) -> bool:
        return bool(np.linalg.norm(position) < self.robot.depth_max_m)  # false for NaN
