"""Plays the episodes of a simulated G1 one after another: gantry, settling, task, pause."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from egovcp.sim.live import EpisodeOutcome, LiveRobot, Phase
from egovcp.sim.scenario import Scenario
from egovcp.spec import PHYSICS_DT

MIN_PAUSE: Final = 1.5  # s: in HOLD the robot takes 1 s to return to its neutral pose


class CommandedRobot(Protocol):
    """A `LiveRobot` that applies motor commands from elsewhere."""

    pressed: frozenset[str]
    """Pressed buttons of the robot's remote control (`remote_control.BUTTONS`)."""

    @property
    def robot(self) -> LiveRobot:
        """The simulation."""
        ...

    @property
    def commanded(self) -> bool:
        """Whether the last command has stiffness, so that the motors hold a pose."""
        ...

    def next_episode(self) -> None:
        """Notify that `robot` has started another episode."""
        ...

    def step(self) -> None:
        """Advance by 5 ms."""
        ...


@dataclass(frozen=True)
class EpisodeSchedule:
    """Durations between the phases of an episode, s of simulated time."""

    gantry: float | None = 3.0
    """How long the motors must hold a pose before the gantry releases the robot; None: it waits
    for `LiveRobot.release`."""
    settle: float = 2.0
    """From there to the beginning of the task."""
    pause: float = 2.0
    """From the end of an episode to the next, which begins on the gantry; at least `MIN_PAUSE`."""


#: Buttons that are pressed in each phase after the first episode.
_HOLD: Final = frozenset({"B"})
_RUN: Final = frozenset({"start"})
_BUTTONS: Final = {
    Phase.OVER: _HOLD,
    Phase.HELD: _HOLD,
    Phase.FREE: _RUN,
    Phase.EPISODE: frozenset[str](),
}


class EpisodeSequencer:
    """Plays one scenario after another.

    Between two episodes it presses the buttons of the remote control as an operator would, because
    a robot must not be lifted or put down while a planner moves it. The first start is left to the
    operator.

    Args:
        robot: advanced by `step`.
        scenarios: number of an episode -> its scenario; None: there are no more.
        log: called with a line for every change of phase.
    """

    def __init__(
        self,
        robot: CommandedRobot,
        scenarios: Callable[[int], Scenario | None],
        schedule: EpisodeSchedule | None = None,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._robot = robot
        self._scenarios = scenarios
        self._schedule = schedule or EpisodeSchedule()
        self._log = log
        self.outcomes: list[EpisodeOutcome] = []
        """Outcomes of the finished episodes."""
        self.finished = False
        """Whether there are no more episodes."""
        self._start()

    def _start(self) -> None:
        scenario = self._scenarios(len(self.outcomes))
        if scenario is None:
            self.finished = True
            return
        self._robot.robot.start(scenario)
        self._robot.next_episode()
        self._enter(Phase.HELD)
        self._log(f"episode {scenario.episode} ({scenario.task}): on the gantry")

    def _enter(self, phase: Phase) -> None:
        self._phase, self._since = phase, 0.0
        if self.outcomes or phase is Phase.OVER:
            self._robot.pressed = _BUTTONS[phase]

    def step(self) -> None:
        """Advance by 5 ms."""
        if self.finished:
            return
        self._robot.step()
        robot, schedule = self._robot.robot, self._schedule
        if robot.phase is not self._phase:
            self._enter(robot.phase)
            self._report()
        self._since += PHYSICS_DT
        if self._phase is Phase.HELD:
            if not self._robot.commanded:
                self._since = 0.0
            elif schedule.gantry is not None and self._since > schedule.gantry:
                robot.release()
        elif self._phase is Phase.FREE and self._since >= schedule.settle:
            robot.begin()
        elif self._phase is Phase.OVER and self._since >= max(MIN_PAUSE, schedule.pause):
            self._start()

    def _report(self) -> None:
        if self._phase is Phase.FREE:
            self._log("the gantry releases the robot")
        elif self._phase is Phase.EPISODE:
            self._log("the task begins")
        elif self._phase is Phase.OVER:
            outcome = self._robot.robot.outcome
            self.outcomes.append(outcome)
            self._log(outcome_text(outcome))


def outcome_text(outcome: EpisodeOutcome) -> str:
    """Describe an outcome in one line."""
    result = "fell" if outcome.fallen else "success" if outcome.success else "failure"
    terms = ", ".join(f"{k} {v:+.3f}" for k, v in outcome.reward_terms.items() if v)
    contacts = ", ".join(f"{part} {force:.0f} N" for part, force in outcome.contacts.items())
    return (
        f"{result} after {outcome.ticks} ticks, reward {outcome.reward:+.3f} "
        f"({terms or 'no terms'}); contacts: {contacts or 'none'}"
    )
