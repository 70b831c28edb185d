"""Base class of the tasks of the G1: scene, event, contacts, rewards, success, and an oracle.

A task of your own is a subclass of `Task` that an installed package names in the entry-point group
``egovcp.tasks``, or that a command gets as ``--task=package.module:Class``. Tasks of a robot of
another kind are subclasses of `egovcp.sim.tasks.RobotTask`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from egovcp.robot_spec import G1, RobotSpec
from egovcp.sim.scene import PARTS, Contact
from egovcp.sim.tasks.base_task import Array, BaseTask
from egovcp.spec import (
    ACTION_BOX,
    CONTROLLER_TICKS_PER_PLAN,
    PHYSICS_DT,
    PHYSICS_STEPS_PER_CONTROLLER_TICK,
    Solid,
)

if TYPE_CHECKING:
    from egovcp.sim.config import EnvConfig
    from egovcp.sim.robot import SimulatedRobot
    from egovcp.sim.scenario import Scenario

__all__ = ["Array", "Task"]

PHYSICS_STEPS_PER_TICK: Final = CONTROLLER_TICKS_PER_PLAN * PHYSICS_STEPS_PER_CONTROLLER_TICK
PARKED: Final = (1000.0, 0.0, 0.0)  # m, of objects that wait far away; no robot walks there
FALL_HEIGHT: Final = 0.40  # m, pelvis; the lowest command is 0.52
FALL_TILT: Final = 1.0  # rad, pelvis; the deepest squat pitches it by 0.5


class Task(BaseTask):
    """One episode of a task; a subclass defines the task, and `VectorEnv` drives the episode.

    Class attributes describe the task, `add_objects` adds its objects to the scene. Per episode:
    ``__init__`` samples parameters and edits the robot's copy of the model, `place` sets the start
    state. Then, per physics step of 5 ms: `before_step`, physics, `process_contacts`; per planner
    tick of 40 ms: `rewards`. All randomness comes from `sample` and `scenario`.
    """

    robot: SimulatedRobot
    constant_poses: ClassVar[tuple[tuple[float, ...], ...]] = (
        (0.2, 0.45, 0.8),
        (0.0, -0.3),
        (0.3, 0.6, 0.85),
        (0.0, -0.6),
    )
    """Grid of the search for the best constant action: forward, outward, up, height, in [-1, 1]."""

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> None:
        super().__init__(config, scenario, robot)
        self.forces = np.zeros(len(PARTS))  # peak per part in the last tick, N

    @classmethod
    def robot_spec(cls) -> RobotSpec:
        """The G1."""
        return G1

    @classmethod
    def physics_clock(cls) -> tuple[float, int]:
        """Duration of a physics step, s, and physics steps per planner tick."""
        return PHYSICS_DT, PHYSICS_STEPS_PER_TICK

    @classmethod
    def constant_actions(cls) -> list[tuple[float, ...]]:
        """The left-right symmetric poses of `constant_poses`, without the neutral one."""
        return [  # 0.0 - x, because -x of 0.0 is -0.0
            (forward, outward, up, forward, 0.0 - outward, up, height)
            for forward, outward, up, height in itertools.product(*cls.constant_poses)
            if any((forward, outward, up, height))
        ]

    def process_contacts(self, contacts: Sequence[Contact]) -> None:
        """Process the contacts between robot and objects of a physics step."""

    @property
    def velocity_command(self) -> Array:
        """(3,) commanded vx, vy (m/s) and yaw rate (rad/s); see `needs_walking`."""
        return np.zeros(3)

    def object_geoms(self) -> tuple[int, ...]:
        """Ids of the geoms of `add_objects`."""
        return tuple(self.robot.index.objects[self.name])

    def solids(self) -> tuple[Solid, ...]:
        """Objects in the scene besides robot and floor: by default all geoms of `add_objects`."""
        return tuple(self._solid(geom) for geom in self.object_geoms())

    def to_heading_frame(self, vector_w: Array) -> Array:
        """(3,) world vector in the axes of the pelvis heading frame."""
        vector: Array = np.einsum("i,ij->j", vector_w, self.robot.heading)
        return vector

    @property
    def object_b(self) -> Array:
        """(3,) position of the object, m, pelvis heading frame."""
        return self.to_heading_frame(self.require_position() - self.robot.data.qpos[:3])

    @staticmethod
    def action_of(
        left: Sequence[float] | Array | None = None,
        right: Sequence[float] | Array | None = None,
        height: float | None = None,
    ) -> Array:
        """(7,) the action that commands palms (3,) and pelvis height, m, heading frame.

        What is None stays neutral; targets are clipped to the action box.
        """
        target = np.array(ACTION_BOX.neutral)
        for part, value in ((slice(0, 3), left), (slice(3, 6), right), (6, height)):
            if value is not None:
                target[part] = value
        return np.clip(ACTION_BOX.to_normalised(target), -1.0, 1.0)

    def begin_tick(self) -> None:
        """Reset the quantities of a planner tick."""
        self.forces[:] = 0.0

    def step(self) -> None:
        """Act on the scene, do one physics step and process its contacts."""
        self.before_step()
        self.record_contacts(self.robot.step())

    def record_contacts(self, contacts: Sequence[Contact]) -> None:
        """Count a physics step and process its contacts."""
        self.physics_steps += 1
        for contact in contacts:
            self.forces[contact.part] = max(self.forces[contact.part], contact.force)
        self.process_contacts(contacts)

    def has_fallen(self) -> bool:
        """Whether the robot has fallen, or is too low or too tilted to recover."""
        robot = self.robot
        return robot.pelvis_height < FALL_HEIGHT or robot.tilt > FALL_TILT or robot.on_floor
