"""Several tasks in one episode: an arch to duck under, then something thrown (figure 4a).

The parameters of a part are those of its task's scenario with the same seed and episode. A part
lasts until a pause after it has finished, at most as long as its task's episodes. Then its object
is parked, and the next part begins around the robot at its current pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final

from egovcp.sim.config import EnvConfig
from egovcp.sim.robot import Contact, SimulatedRobot
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.arch import ArchTask
from egovcp.sim.tasks.ball import BallTask
from egovcp.sim.tasks.base import Array, ObjectState, Solid, Task
from egovcp.sim.tasks.wall import WallTask

SINGLE: Final[dict[str, type[Task]]] = {"ball": BallTask, "wall": WallTask, "arch": ArchTask}


class SequenceTask(Task):
    """Plays its parts in turn; the rewards are those of the current part."""

    terms: ClassVar = tuple(dict.fromkeys(term for kind in SINGLE.values() for term in kind.terms))

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> None:
        super().__init__(config, scenario, robot)
        made = {
            name: kind(config, replace(scenario, task=name), robot) for name, kind in SINGLE.items()
        }
        self._all = tuple(made.values())  # the others stay parked
        self._parts = tuple(made[name] for name in config.sequence.parts)
        self._pause = config.sequence.pause_ticks
        self._at = 0
        self._finished_ticks = 0
        self.event_tick = self._parts[0].event_tick

    @property
    def _part(self) -> Task:
        return self._parts[self._at]

    @property
    def current_name(self) -> str:
        return self._part.name

    @property
    def parameters(self) -> dict[str, float]:
        """Those of every part, prefixed by its name; event ticks count from its begin, -1: none."""
        drawn: dict[str, float] = {}
        for part in self._parts:
            drawn |= {f"{part.name}.{name}": value for name, value in part.parameters.items()}
            event = part.event_tick
            drawn[f"{part.name}.event_tick"] = -1 if event is None else event
        return drawn

    @property
    def since_event(self) -> float:
        return self._part.since_event

    @property
    def velocity_command(self) -> Array:
        return self._part.velocity_command

    def place(self) -> None:
        self.park()
        self._part.place()

    def begin_tick(self) -> None:
        """Begin the next part if the current one is over."""
        super().begin_tick()
        self._finished_ticks += self._part.finished
        if self._part is not self._parts[-1] and self._part_is_over(self._finished_ticks):
            self._part.park()
            self._at, self._finished_ticks = self._at + 1, 0
            self._part.place()
        self._part.begin_tick()

    def _part_is_over(self, finished_ticks: int) -> bool:
        """Whether the current part finished a pause ago, or reached its time limit."""
        return finished_ticks > self._pause or self._part.is_over

    @property
    def is_over(self) -> bool:
        """Whether the last part is over."""
        last = self._part is self._parts[-1]
        return last and self._part_is_over(self._finished_ticks + self._part.finished)

    def park(self) -> None:
        for task in self._all:
            task.park()

    def before_step(self) -> None:
        """Move the current part's object, and keep the others parked."""
        for task in self._all:
            if task is not self._part:
                task.park()
        self._part.before_step()

    def process_contacts(self, contacts: Sequence[Contact]) -> None:
        self._part.after_step(contacts)

    def rewards(self, action: Array) -> dict[str, float]:
        return dict.fromkeys(self.terms, 0.0) | self._part.rewards(action)

    @property
    def fall_cost(self) -> float:
        return self._part.fall_cost

    @property
    def achieved(self) -> bool:
        """Every part has begun and is achieved."""
        return self._part is self._parts[-1] and all(part.achieved for part in self._parts)

    @property
    def parts(self) -> dict[str, bool]:
        """Whether each has begun and been achieved; a fall counts against the part it ends."""
        return {
            part.name: k <= self._at and part.achieved and not (self.fallen and k == self._at)
            for k, part in enumerate(self._parts)
        }

    def state(self) -> ObjectState:
        return self._part.state()

    def solids(self) -> tuple[Solid, ...]:
        return self._part.solids()
