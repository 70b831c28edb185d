"""Base class of the tasks of a robot of another kind than the G1."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any, ClassVar, Final

import mujoco
import numpy as np

from egovcp.errors import EgovcpError
from egovcp.robot_spec import RobotSpec
from egovcp.sim.mujoco_robot import MujocoRobot
from egovcp.sim.tasks.base_task import Array, BaseTask
from egovcp.spec import Solid

_CONSTANTS: Final = (-0.7, 0.0, 0.7)
_GRID_ACTIONS: Final = 4  # more would make the grid of constant actions too large
_PLANE: Final = int(mujoco.mjtGeom.mjGEOM_PLANE)


class RobotTask(BaseTask):
    """One episode of a task of `robot_class`.

    Class attributes describe the task, `add_objects` adds its objects to the scene of the robot.
    Per episode: ``__init__`` samples parameters, `place` sets the start state. Then, per physics
    step: `before_step`, physics, `after_step`; per planner tick: `rewards`. All randomness comes
    from `sample` and `scenario`.
    """

    robot_class: ClassVar[type[MujocoRobot]]
    """The robot that does the task."""
    robot: Any
    """The instance of `robot_class` of this episode."""

    @classmethod
    def robot_spec(cls) -> RobotSpec:
        """``robot_class.spec``."""
        return cls.robot_class.spec

    @classmethod
    def physics_clock(cls) -> tuple[float, int]:
        """Duration of a physics step, s, and physics steps per planner tick."""
        timestep = float(cls.scene().opt.timestep)
        return timestep, cls.robot_class.physics_clock(timestep)

    @classmethod
    def constant_actions(cls) -> list[tuple[float, ...]]:
        """All combinations of -0.7, 0 and 0.7 for up to 4 actions, without the neutral one; with
        more, one action at a time."""
        count = cls.robot_spec().action_dim
        if count <= _GRID_ACTIONS:
            return [a for a in itertools.product(_CONSTANTS, repeat=count) if any(a)]
        rows = [value * row for row in np.eye(count) for value in _CONSTANTS if value]
        return [tuple(row.tolist()) for row in rows]

    @classmethod
    @cache
    def scene(cls) -> mujoco.MjModel:
        """The model of robot and objects, compiled once and shared: each episode gets a copy.

        Raises:
            EnvironmentFailure: it does not compile, or does not fit the robot's description.
        """
        try:
            spec = cls.robot_class.build()
            cls.add_objects(spec)
            model = spec.compile()
            cls.robot_class(model)
        except EgovcpError:
            raise
        except Exception as error:
            raise cls.error(f"its scene cannot be made: {error}") from error
        return model

    def after_step(self) -> None:
        """Called after each physics step, e.g. to read contacts; does nothing by default."""

    def step(self) -> None:
        """Act on the scene and do one physics step."""
        self.before_step()
        self.robot.step()
        self.physics_steps += 1
        self.after_step()

    def has_fallen(self) -> bool:
        """Whether the episode has failed, which ends it; by default never."""
        return False

    def solids(self) -> tuple[Solid, ...]:
        """All geoms that are not planes: links of the robot, and objects."""
        kinds = self.robot.model.geom_type
        return tuple(self._solid(int(i)) for i in np.flatnonzero(kinds != _PLANE))

    @property
    def object_b(self) -> Array:
        """(3,) position of the object, m, base frame of the robot."""
        pose = self.robot.base_pose
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, pose[3:])
        position: Array = (self.require_position() - pose[:3]) @ rotation.reshape(3, 3)
        return position
