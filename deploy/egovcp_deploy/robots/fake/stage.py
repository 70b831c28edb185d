"""Leads the fake robot through its episodes: crane, settling, task, pause, and again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from egovcp.sim.live import EpisodeOutcome, LiveRobot, Phase
from egovcp.sim.scenario import Scenario
from egovcp.spec import PHYSICS_DT

LEAST_PAUSE: Final = 1.5  # s: a robot that is told to hold eases to its neutral pose in 1 s


class Plant(Protocol):
    """A simulated robot and whoever passes it its commands."""

    pressed: frozenset[str]
    """Buttons of the robot's remote control that are held down (`remote.BUTTONS`)."""

    @property
    def robot(self) -> LiveRobot:
        """The robot."""
        ...

    @property
    def commanded(self) -> bool:
        """Whether the motors are told to hold anything."""
        ...

    def next_episode(self) -> None:
        """The robot has started another episode."""
        ...

    def step(self) -> None:
        """Let 5 ms pass."""
        ...


@dataclass(frozen=True)
class Schedule:
    """When one thing leads to the next, s of simulated time."""

    gantry: float | None = 3.0
    """How long the motors must be told to hold something before the crane lets go; None: it
    waits to be told."""
    settle: float = 2.0
    """From there to the beginning of the task."""
    pause: float = 2.0
    """From the end of an episode to the next, which begins on the crane; never less than
    `LEAST_PAUSE`."""


#: What is pressed in which phase, once an episode is over.
_HOLD: Final = frozenset({"B"})
_RUN: Final = frozenset({"start"})
_BUTTONS: Final = {
    Phase.OVER: _HOLD,
    Phase.HELD: _HOLD,
    Phase.FREE: _RUN,
    Phase.EPISODE: frozenset[str](),
}


class Stage:
    """Plays one scenario after the other.

    Between two of them it presses the buttons that an operator would: a robot must not be lifted
    off the ground, nor put down, while a planner moves it.

    Args:
        plant: the robot, behind a wire or not.
        scenarios: number of an episode -> its scenario; None: there are no more.
        tell: is told what happens, in words.
    """

    def __init__(
        self,
        plant: Plant,
        scenarios: Callable[[int], Scenario | None],
        schedule: Schedule | None = None,
        tell: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._plant = plant
        self._scenarios = scenarios
        self._schedule = schedule or Schedule()
        self._tell = tell
        self.outcomes: list[EpisodeOutcome] = []
        """Of the episodes that are over."""
        self.finished = False
        """Whether there are no more episodes."""
        self._start()

    def _start(self) -> None:
        scenario = self._scenarios(len(self.outcomes))
        if scenario is None:
            self.finished = True
            return
        self._plant.robot.start(scenario)
        self._plant.next_episode()
        self._enter(Phase.HELD)
        self._tell(f"episode {scenario.episode} ({scenario.task}): on the crane")

    def _enter(self, phase: Phase) -> None:
        self._phase, self._since = phase, 0.0
        if self.outcomes or phase is Phase.OVER:  # before, whoever operates it does all by himself
            self._plant.pressed = _BUTTONS[phase]

    def step(self) -> None:
        """5 ms."""
        if self.finished:
            return
        self._plant.step()
        robot = self._plant.robot
        if robot.phase is not self._phase:
            self._enter(robot.phase)
            self._announce()
        self._since += PHYSICS_DT
        if self._phase is Phase.HELD:
            self._wait_for_commands()
        elif self._phase is Phase.FREE and self._since >= self._schedule.settle:
            robot.begin()
        elif self._phase is Phase.OVER and self._since >= max(LEAST_PAUSE, self._schedule.pause):
            self._start()

    def _wait_for_commands(self) -> None:
        if not self._plant.commanded:
            self._since = 0.0
        elif self._schedule.gantry is not None and self._since > self._schedule.gantry:
            self._plant.robot.release()

    def _announce(self) -> None:
        if self._phase is Phase.FREE:
            self._tell("the crane lets go")
        elif self._phase is Phase.EPISODE:
            self._tell("the task begins")
        elif self._phase is Phase.OVER:
            outcome = self._plant.robot.outcome
            self.outcomes.append(outcome)
            self._tell(spoken(outcome))


def spoken(outcome: EpisodeOutcome) -> str:
    """An outcome in one paragraph."""
    verdict = "fell" if outcome.fallen else "success" if outcome.success else "failure"
    terms = ", ".join(f"{k} {v:+.3f}" for k, v in outcome.reward_terms.items() if v)
    contacts = ", ".join(f"{part} {force:.0f} N" for part, force in outcome.contacts.items())
    return (
        f"{verdict} after {outcome.ticks} ticks, reward {outcome.reward:+.3f} "
        f"({terms or 'nothing'}); contacts: {contacts or 'none'}"
    )
