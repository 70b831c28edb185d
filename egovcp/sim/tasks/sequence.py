"""Several tasks in one episode: an arch to duck under, then something thrown (figure 4a).

A part draws what its task draws alone: the arch and the throw of sequence i are those of the arch
and ball scenarios i of the same seed. It lasts until a pause after the moment that decides it, or
as long as its own episodes. Then its object is taken away, and the next part begins around the
robot as it stands: at any time one object at most is in sight and reach, and contacts are its.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Final

from egovcp.sim.config import EnvConfig
from egovcp.sim.robot import SimulatedRobot, Touch
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.arch import ArchTask
from egovcp.sim.tasks.ball import BallTask
from egovcp.sim.tasks.base import Array, ObjectState, Solid, Task
from egovcp.sim.tasks.wall import WallTask

SINGLE: Final[dict[str, type[Task]]] = {"ball": BallTask, "wall": WallTask, "arch": ArchTask}


class SequenceTask(Task):
    """Plays its parts one after the other; each tick is rewarded as the present part's."""

    terms: ClassVar = tuple(dict.fromkeys(term for kind in SINGLE.values() for term in kind.terms))

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> None:
        super().__init__(config, scenario, robot)
        made = {
            name: kind(config, replace(scenario, task=name), robot) for name, kind in SINGLE.items()
        }
        self._all = tuple(made.values())  # what is not played stays parked
        self._parts = tuple(made[name] for name in config.sequence.parts)
        self._pause = config.sequence.pause_ticks
        self._at = 0
        self._settled_ticks = 0
        self.event_tick = self._parts[0].event_tick

    @property
    def _part(self) -> Task:
        """The part that is played now."""
        return self._parts[self._at]

    @property
    def present(self) -> str:
        """Name of the part that is played now."""
        return self._part.name

    @property
    def parameters(self) -> dict[str, float]:
        """Those of every part under its name; events are counted from the beginning of the part,
        -1 where there is none."""
        drawn: dict[str, float] = {}
        for part in self._parts:
            drawn |= {f"{part.name}.{name}": value for name, value in part.parameters.items()}
            event = part.event_tick
            drawn[f"{part.name}.event_tick"] = -1 if event is None else event
        return drawn

    @property
    def since_event(self) -> float:
        """Seconds since the event of the present part."""
        return self._part.since_event

    @property
    def velocity_command(self) -> Array:
        """(3,) what the present part commands."""
        return self._part.velocity_command

    def place(self) -> None:
        """Put the first part's object where it starts, and no other."""
        self.park()
        self._part.place()

    def begin_tick(self) -> None:
        """Go on to the next part if the present one is over."""
        super().begin_tick()
        self._settled_ticks += self._part.settled
        if self._part is not self._parts[-1] and self._is_decided(self._settled_ticks):
            self._part.park()
            self._at, self._settled_ticks = self._at + 1, 0
            self._part.place()
        self._part.begin_tick()

    def _is_decided(self, settled_ticks: int) -> bool:
        """Whether the present part has been decided for a while, or its time is up."""
        return settled_ticks > self._pause or self._part.is_over

    @property
    def is_over(self) -> bool:
        """Whether that is so of the last part: an oracle that has braced on a wall for as long as
        wall episodes last lets go of it afterwards, and falls."""
        last = self._part is self._parts[-1]
        return last and self._is_decided(self._settled_ticks + self._part.settled)

    def park(self) -> None:
        """Take all objects away."""
        for task in self._all:
            task.park()

    def act(self) -> None:
        """Move the present part's object, and keep the others away."""
        for task in self._all:
            if task is not self._part:
                task.park()
        self._part.act()

    def observe(self, touches: Sequence[Touch]) -> None:
        """Let the present part look."""
        self._part.see(touches)

    def rewards(self, action: Array) -> dict[str, float]:
        """Those of the present part; zero for the terms of the others."""
        return dict.fromkeys(self.terms, 0.0) | self._part.rewards(action)

    @property
    def fall_cost(self) -> float:
        """That of the present part."""
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
        """The truth about the present part's object."""
        return self._part.state()

    def solids(self) -> tuple[Solid, ...]:
        """The present part's object."""
        return self._part.solids()
