"""Base class of the tasks: an event, contacts, named reward terms and success."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from egovcp.sim.config import ArchConfig, BallConfig, EnvConfig, WallConfig
from egovcp.sim.robot import Contact, SimulatedRobot
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import PARTS
from egovcp.spec import CONTROLLER_TICKS_PER_PLAN, PHYSICS_DT, PHYSICS_STEPS_PER_CONTROLLER_TICK

Array = NDArray[np.float64]

PHYSICS_STEPS_PER_TICK: Final = CONTROLLER_TICKS_PER_PLAN * PHYSICS_STEPS_PER_CONTROLLER_TICK
FALL_HEIGHT: Final = 0.40  # m, pelvis; the lowest command is 0.52
FALL_TILT: Final = 1.0  # rad, pelvis; the deepest squat pitches it by 0.5


@dataclass(frozen=True)
class Solid:
    """An object in the scene, for visualisation."""

    name: str
    shape: Literal["sphere", "box"]
    size: tuple[float, float, float]  # Half sizes of a box, or the radius three times, m
    position_w: Array  # (3,) centre, m
    quaternion_w: Array  # (4,) wxyz


@dataclass(frozen=True)
class ObjectState:
    """State of the task's object; quantities that a task lacks are NaN."""

    position_w: Array
    """(3,) ball centre, wall surface before the robot, or arch centre on the ground, m."""
    velocity_w: Array  # (3,) m/s
    size: float  # Ball radius, or clearance under the arch, m
    active: bool  # Ball in flight, robot pushed and still disturbed, or arch on the move


class Task(ABC):
    """One episode of a task. Called once per physics step and once per planner tick."""

    config: BallConfig | WallConfig | ArchConfig
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

    def _sample(self, scenario: Scenario, *names: str) -> dict[str, float]:
        """Sample ``names`` uniformly from the config's ranges ``<name>_range``, in this order."""
        rng = scenario.rng("geometry")
        ranges = ((name, getattr(self.config, f"{name}_range")) for name in names)
        self._parameters = {name: float(rng.uniform(*limits)) for name, limits in ranges}
        return self._parameters

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
    def current_name(self) -> str:
        """Name of the current task, whose object `state` describes."""
        return self.name

    @property
    def velocity_command(self) -> Array:
        """(3,) commanded vx, vy (m/s) and yaw rate (rad/s)."""
        return np.zeros(3)

    def begin_tick(self) -> None:
        """Reset the quantities of a planner tick."""
        self.forces[:] = 0.0

    def step(self) -> None:
        """Act on the scene, do one physics step and process its contacts."""
        self.before_step()
        self.after_step(self.robot.step())

    def after_step(self, contacts: Sequence[Contact]) -> None:
        """Count a physics step and process its contacts."""
        self.physics_steps += 1
        for contact in contacts:
            self.forces[contact.part] = max(self.forces[contact.part], contact.force)
        self.process_contacts(contacts)

    def end_tick(self, action: Array) -> dict[str, float]:
        """Reward terms of the planner tick in which ``action`` (7,) was sent."""
        was_fallen, self.fallen = self.fallen, self.fallen or self.has_fallen()
        terms = self.rewards(action)
        terms["fall"] = -self.fall_cost if self.fallen and not was_fallen else 0.0
        return terms

    def has_fallen(self) -> bool:
        """Whether the robot lies, or is too low or too tilted to recover."""
        robot = self.robot
        return robot.pelvis_height < FALL_HEIGHT or robot.tilt > FALL_TILT or robot.on_floor

    @property
    def success(self) -> bool:
        """Whether the task would count as achieved if the episode ended now."""
        return self.achieved and not self.fallen

    @property
    def parts(self) -> dict[str, bool]:
        """Success of each part of a sequence; empty for a single task."""
        return {}

    @property
    def finished(self) -> bool:
        """Whether the object no longer matters: ball on the floor, arch passed."""
        return False

    @property
    def fall_cost(self) -> float:
        """Cost of a fall."""
        return self.config.fall_cost

    @property
    @abstractmethod
    def achieved(self) -> bool:
        """`success`, regardless of falls."""

    @property
    def parameters(self) -> dict[str, float]:
        """Sampled parameters of this episode, SI units."""
        return self._parameters

    @abstractmethod
    def place(self) -> None:
        """Place the objects for the start of the episode, around the standing robot."""

    @abstractmethod
    def park(self) -> None:
        """Move the objects out of sight and reach; call it before every physics step."""

    @abstractmethod
    def before_step(self) -> None:
        """Move objects and push the robot, before a physics step."""

    @abstractmethod
    def process_contacts(self, contacts: Sequence[Contact]) -> None:
        """Process the contacts between robot and object of a physics step."""

    @abstractmethod
    def rewards(self, action: Array) -> dict[str, float]:
        """Reward terms of the tick but for ``fall``."""

    @abstractmethod
    def state(self) -> ObjectState:
        """State of the object."""

    @abstractmethod
    def solids(self) -> tuple[Solid, ...]:
        """Objects in the scene besides robot and floor."""
