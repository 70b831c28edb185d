"""What every task has: an event, contacts, named reward terms and an outcome."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from egovcp.sim.config import EnvConfig
from egovcp.sim.robot import SimulatedRobot, Touch
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import PARTS
from egovcp.spec import CONTROLLER_TICKS_PER_PLAN, PHYSICS_DT, PHYSICS_STEPS_PER_CONTROLLER_TICK

Array = NDArray[np.float64]

PHYSICS_STEPS_PER_TICK: Final = CONTROLLER_TICKS_PER_PLAN * PHYSICS_STEPS_PER_CONTROLLER_TICK
FALL_HEIGHT: Final = 0.40  # m, pelvis; the lowest command is 0.52
FALL_TILT: Final = 1.0  # rad, pelvis; the deepest squat pitches it by 0.5


@dataclass(frozen=True)
class Solid:
    """A thing in the scene, for pictures of it."""

    name: str
    """What it is."""
    shape: Literal["sphere", "box"]
    """Kind of geometry."""
    size: tuple[float, float, float]
    """Half sizes of a box, or the radius three times, m."""
    position_w: Array
    """(3,) centre, m."""
    quaternion_w: Array
    """(4,) wxyz."""


@dataclass(frozen=True)
class ObjectState:
    """The truth about the task's object; quantities that a task lacks are NaN."""

    position_w: Array
    """(3,) ball centre, wall surface before the robot, or arch centre on the ground, m."""
    velocity_w: Array
    """(3,) m/s."""
    size: float
    """Ball radius, or clearance under the arch, m."""
    active: bool
    """Ball in flight, robot pushed and still disturbed, or arch on the move."""


class Task(ABC):
    """One episode of a task. Called once per physics step and once per planner tick."""

    terms: ClassVar[tuple[str, ...]]
    """Names of the reward terms."""

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> None:
        self.name = scenario.task
        self.robot = robot
        episode = config.episode(scenario.task)
        rng = scenario.rng("event")
        low, high = episode.event_ticks
        tick = int(rng.integers(low, high + 1))
        empty = bool(rng.random() < episode.empty_probability)
        self.event_tick: int | None = None if empty else tick
        self.ticks_limit = episode.ticks
        self.physics_steps = 0
        self.fallen = False
        self.forces = np.zeros(len(PARTS))  # peak per part in the last tick, N

    @property
    def time(self) -> float:
        """Seconds since the start of the episode."""
        return self.physics_steps * PHYSICS_DT

    @property
    def is_over(self) -> bool:
        """Whether the time limit is reached."""
        return self.physics_steps >= self.ticks_limit * PHYSICS_STEPS_PER_TICK

    @property
    def since_event(self) -> float:
        """Seconds since the event; negative before it, -inf in an empty episode."""
        if self.event_tick is None:
            return -np.inf
        return (self.physics_steps - self.event_tick * PHYSICS_STEPS_PER_TICK) * PHYSICS_DT

    @property
    def present(self) -> str:
        """Name of the task that is played now, of which `state` tells the truth."""
        return self.name

    @property
    def velocity_command(self) -> Array:
        """(3,) commanded vx, vy (m/s) and yaw rate (rad/s)."""
        return np.zeros(3)

    def begin_tick(self) -> None:
        """Forget what the last planner tick saw."""
        self.forces[:] = 0.0

    def step(self) -> None:
        """Act on the scene, do one physics step and look at its contacts."""
        self.act()
        self.see(self.robot.step())

    def see(self, touches: Sequence[Touch]) -> None:
        """Count a physics step that has been done, and look at its contacts."""
        self.physics_steps += 1
        for touch in touches:
            self.forces[touch.part] = max(self.forces[touch.part], touch.force)
        self.observe(touches)

    def end_tick(self, action: Array) -> dict[str, float]:
        """Reward terms of the planner tick in which ``action`` (7,) was sent."""
        was_fallen, self.fallen = self.fallen, self.fallen or self.has_fallen()
        terms = self.rewards(action)
        terms["fall"] = -self.fall_cost if self.fallen and not was_fallen else 0.0
        return terms

    def has_fallen(self) -> bool:
        """Whether the robot lies or is past saving."""
        robot = self.robot
        return robot.pelvis_height < FALL_HEIGHT or robot.tilt > FALL_TILT or robot.on_floor

    @property
    def success(self) -> bool:
        """Whether the task would count as achieved if the episode ended now."""
        return self.achieved and not self.fallen

    @property
    def parts(self) -> dict[str, bool]:
        """Of several tasks in one episode, the success of each; of a single task, nothing."""
        return {}

    @property
    def settled(self) -> bool:
        """Whether nothing that happens to the object from now on is likely to matter."""
        return False

    @property
    @abstractmethod
    def fall_cost(self) -> float:
        """Cost of a fall."""

    @property
    @abstractmethod
    def achieved(self) -> bool:
        """`success`, falls aside."""

    @property
    @abstractmethod
    def parameters(self) -> dict[str, float]:
        """What was drawn for this episode, for the record; SI units."""

    @abstractmethod
    def place(self) -> None:
        """Put the objects where the episode starts; the robot already stands."""

    @abstractmethod
    def park(self) -> None:
        """Take the objects out of the robot's sight and reach; they stay there if this is called
        before every physics step."""

    @abstractmethod
    def act(self) -> None:
        """Move objects and push the robot, before a physics step."""

    @abstractmethod
    def observe(self, touches: Sequence[Touch]) -> None:
        """Look at the contacts between robot and object after a physics step."""

    @abstractmethod
    def rewards(self, action: Array) -> dict[str, float]:
        """Reward terms of the tick, the fall aside."""

    @abstractmethod
    def state(self) -> ObjectState:
        """The truth about the object."""

    @abstractmethod
    def solids(self) -> tuple[Solid, ...]:
        """What stands in the scene beside robot and floor."""
