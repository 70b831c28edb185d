"""Several tasks in one episode, by default arch, ball and wall (figure 4a of the paper).

The parameters of a part are those of its task's scenario with the same seed and episode. A part
lasts until a pause after it has finished, at most as long as its task's episodes. Then its object
is parked, and the next part begins around the robot at its current pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Final, cast

import mujoco

from egovcp.bounds import bounded, check_bounds
from egovcp.errors import UsageError
from egovcp.sim.tasks.arch import ArchTask
from egovcp.sim.tasks.ball import BallTask
from egovcp.sim.tasks.base import Array, Task
from egovcp.sim.tasks.options import MAX_TICKS, EpisodeConfig
from egovcp.sim.tasks.registry import find_task
from egovcp.sim.tasks.wall import WallTask
from egovcp.spec import REWARD_TERMS, Solid

if TYPE_CHECKING:
    from egovcp.sim.config import BaseEnvConfig, EnvConfig
    from egovcp.sim.robot import SimulatedRobot
    from egovcp.sim.scenario import Scenario
    from egovcp.sim.scene import Contact

#: Tasks whose objects are in every sequence, in the order of the compiled scene.
_ALWAYS: Final = (ArchTask, WallTask, BallTask)


@dataclass(frozen=True)
class SequenceConfig:
    """Several tasks in one episode, in turn (--task=sequence)."""

    parts: tuple[str, ...] = ("arch", "ball", "wall")
    """Its tasks in their order, each at most once. The wall, on which the robot leans, can only be
    the last."""
    pause_ticks: int = bounded(25, least=0, most=MAX_TICKS)
    """Planner ticks from the end of a part (arch passed, ball on the floor) to the next one. A part
    takes at most the ticks of its task's episodes."""

    def __post_init__(self) -> None:
        check_bounds(self)


def _parts(config: BaseEnvConfig) -> list[type[Task]]:
    return [
        cast(type[Task], find_task(name)) for name in config.options_of(SequenceTask.name).parts
    ]


class SequenceTask(Task):
    """Plays its parts in turn; the rewards are those of the current part."""

    name = "sequence"
    description = "several tasks in one episode, in turn"
    terms: ClassVar = {}
    config: SequenceConfig = SequenceConfig()
    episode = None
    for_training = False
    constant_poses = ((0.2, 0.45), (0.0, -0.3), (0.35, 0.6), (0.0, -0.6, -1.0))
    seed_key = 3

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> None:
        super().__init__(config, scenario, robot)
        made = {
            task.name: task(config, replace(scenario, task=task.name), robot)
            for task in self.scene_tasks(config)
        }
        self._all = tuple(made.values())  # the others stay parked
        self._parts = tuple(made[name] for name in self.config.parts)
        self._pause = self.config.pause_ticks
        self._at = 0
        self._finished_ticks = 0
        self.event_tick = self._parts[0].event_tick
        for part in self._parts:
            event = part.event_tick
            drawn = part.parameters | {"event_tick": -1 if event is None else event}
            self.parameters |= {f"{part.name}.{name}": value for name, value in drawn.items()}
        terms = {name: column for task in self._all for name, column in task.reward_terms.items()}
        order = dict.fromkeys((*REWARD_TERMS, *terms))
        self._terms = {name: terms[name] for name in order}

    @classmethod
    def add_objects(cls, spec: mujoco.MjSpec) -> None:
        """Nothing: see `scene_tasks`."""

    @classmethod
    def scene_tasks(cls, config: BaseEnvConfig) -> tuple[type[Task], ...]:
        return tuple(dict.fromkeys((*_ALWAYS, *_parts(config))))

    @classmethod
    def walks(cls, config: BaseEnvConfig) -> bool:
        return any(part.walks(config) for part in _parts(config))

    @classmethod
    def episode_config(cls, config: BaseEnvConfig) -> EpisodeConfig:
        """The length of all parts and the timing of the first."""
        parts = [part.episode_config(config) for part in _parts(config)]
        return replace(parts[0], ticks=sum(part.ticks for part in parts))

    @classmethod
    def check_options(cls, config: BaseEnvConfig) -> None:
        parts = config.options_of(cls.name).parts
        if not parts or len(set(parts)) < len(parts):
            raise UsageError(
                f"env.sequence.parts={list(parts)}: expected at least one task, each at most once"
            )
        for name in parts:
            place = find_task(name, "env.sequence.parts").in_sequence
            if place == "no":
                raise UsageError(f"env.sequence.parts: {name} cannot be part of a sequence")
            if place == "last" and name != parts[-1]:
                raise UsageError(
                    f"env.sequence.parts={list(parts)}: expected {name} only at the end"
                )

    @property
    def reward_terms(self) -> dict[str, str]:
        return self._terms

    @property
    def _part(self) -> Task:
        return self._parts[self._at]

    @property
    def current_name(self) -> str:
        return self._part.name

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
        self._part.record_contacts(contacts)

    def rewards(self) -> dict[str, float]:
        return dict.fromkeys(self._terms, 0.0) | self._part.rewards()

    def oracle(self) -> Array:
        return self._part.oracle()

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

    @property
    def object_w(self) -> Array:
        return self._part.object_w

    def solids(self) -> tuple[Solid, ...]:
        return self._part.solids()
