"""`egovcp-fake-g1`: a simulated G1 in real time behind the protocol of LeRobot's bridge."""

from __future__ import annotations

import io
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from itertools import count
from typing import Any, Final

from egovcp.bounds import bounded
from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.outputs import output_file, write_report
from egovcp.rate import NS_PER_S, Clock, MonotonicClock
from egovcp.sim.config import EnvConfig, evaluation_config
from egovcp.sim.live import EpisodeOutcome, LiveRobot, Phase
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.registry import DEFAULT_TASK
from egovcp.spec import PHYSICS_DT
from egovcp.terminal import echo
from egovcp.workers import stop_on_signal
from egovcp_deploy.options import SEEDS, held_out
from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from egovcp_deploy.robots.fake.faults import FAULT_COMMANDS, InjectedFaults

PROG: Final = "egovcp-fake-g1"
_STEP_NS: Final = round(PHYSICS_DT * NS_PER_S)
_MIN_PAUSE: Final = 1.5  # s: in HOLD the hands take up to 1 s to return to the neutral pose
_MAX_STEPS: Final = 20  # caught up after a delay; the rest are dropped
_EPILOG: Final = (
    "Motors use LeRobot's JSON over ZMQ, depth the format of egovcp-depth-server. Without a "
    "command for 0.2 s the motors damp; assume that a real robot's keep the last command. It reads "
    "commands from the terminal, one per line: Enter or release makes the gantry release the "
    f"robot, quit ends the program, and {', '.join(FAULT_COMMANDS)} inject faults (push 0.5 0, "
    "drop 0.3, mode 4, hot_motor left_knee 125, dropped_motor left_knee, other_publisher off, "
    "clear)."
)


@dataclass(frozen=True)
class FakeG1Config:
    """A simulated G1 for egovcp-deploy --robot.type=unitree_g1 and for tests.

    Plays held-out scenarios of one task; each starts on the gantry and ends with a fall or at the
    time limit.
    """

    task: str = DEFAULT_TASK
    """Scene: a name from `egovcp-task list`, or package.module:Class."""
    seed: int = bounded(0, least=0, below=SEEDS)
    """Seed of the held-out scenarios, as in egovcp-eval."""
    episode: int = bounded(0, least=0)
    """Number of the first scenario."""
    episodes: int = bounded(0, least=0, most=1_000_000)
    """Number of episodes; 0: until interrupted."""
    gantry: float | None = bounded(3.0, least=0)
    """How long the motors must have held a pose without a break before the gantry releases the
    robot, s; 0: at the first command; null: only on the command release."""
    settle: float = bounded(2.0, least=0)
    """Delay between release and the start of the task, s."""
    pause: float = bounded(2.0, least=_MIN_PAUSE)
    """Time between the end of an episode and the next, which starts on the gantry, s."""
    ports: Ports = field(default_factory=Ports)
    """Where to listen."""
    detailed: bool = False
    """Report casing and winding temperatures and status of each motor in every state; LeRobot's
    bridge sends one temperature and no status."""
    json: str = output_file()
    """File for the outcomes, rewritten after each episode."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation. The controller only selects the pose to stand in
    and whether the robot can walk; the delay of actions is that of the connection."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(FakeG1Config, run, argv, prog=PROG, epilog=_EPILOG)


def run(config: FakeG1Config) -> None:
    """Serve until the episodes are over or the user interrupts it. Raises `EnvironmentFailure` if a
    port is in use."""
    with stop_on_signal(signals=(signal.SIGINT,)) as interrupts:
        _serve(config, interrupts)
    if interrupts:
        _print("interrupted")


def _serve(config: FakeG1Config, interrupts: Sequence[int]) -> None:
    """Serve until the episodes are over or a signal handler extends ``interrupts``."""
    numbers = range(config.episodes) if config.episodes else count()
    scenarios = (held_out(config.task, config.seed, config.episode + i) for i in numbers)
    lines = queue.SimpleQueue[str]()
    with closing(FakeBridge(LiveRobot(config.env), config.ports, config.detailed)) as bridge:
        episodes, ports = EpisodeSequencer(bridge, config, scenarios, _print), bridge.ports
        _print(
            f"listening on {ports.host}: commands {ports.command_port}, states {ports.state_port}, "
            f"depth {ports.camera_port}; Ctrl-C ends it"
        )
        threading.Thread(target=_read_lines, args=(lines,), daemon=True).start()
        pacer, written = StepPacer(MonotonicClock()), 0
        try:
            while not (episodes.finished or interrupts):
                for _ in range(pacer.wait_for_steps()):
                    episodes.step()
                if not _apply_lines(lines, bridge.faults):
                    return
                if bridge.faults.crash:
                    os._exit(1)
                if len(episodes.outcomes) > written:
                    written = len(episodes.outcomes)
                    _write_outcomes(config.json, episodes.outcomes)
        finally:
            _write_outcomes(config.json, episodes.outcomes)
            if outcomes := episodes.outcomes:
                successes = sum(outcome.success for outcome in outcomes)
                _print(f"{len(outcomes)} episodes, {successes} successes")


def _write_outcomes(file: str, outcomes: Sequence[EpisodeOutcome]) -> None:
    report = [outcome_json(outcome) for outcome in outcomes]
    write_report(file, report, durable=False)  # fsync delays the robot


def _apply_lines(lines: queue.SimpleQueue[str], faults: InjectedFaults) -> bool:
    """Apply the commands that were typed; false after `quit`."""
    while not lines.empty():
        line = lines.get()
        if line == "quit":
            return False
        try:
            _print(faults.apply(line))
        except UsageError as error:
            _print(str(error))
    return True


def _read_lines(lines: queue.SimpleQueue[str]) -> None:
    """Commands from the terminal; runs in a thread, which no input ends."""
    if isinstance(sys.stdin, io.TextIOWrapper):  # None if it was closed, `<&-`
        sys.stdin.reconfigure(errors="backslashreplace")
        for line in sys.stdin:
            lines.put(line.strip())


#: Buttons that are pressed in each phase after the first episode.
_BUTTONS: Final = {
    Phase.OVER: frozenset({"B"}),
    Phase.HELD: frozenset({"B"}),
    Phase.FREE: frozenset({"start"}),
    Phase.EPISODE: frozenset[str](),
}


class EpisodeSequencer:
    """Plays one scenario after another.

    Between two episodes it presses the buttons of the remote control as an operator would, because
    a robot must not be lifted or put down while a planner moves it. The first start is left to the
    operator.

    Args:
        robot: advanced by `step`.
        config: ``gantry``, ``settle`` and ``pause``, in simulated time.
        scenarios: those of the episodes, in order.
        log: called with a line for every change of phase.
    """

    def __init__(
        self,
        robot: FakeBridge,
        config: FakeG1Config,
        scenarios: Iterator[Scenario],
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._robot = robot
        self._config = config
        self._scenarios = scenarios
        self._log = log
        self.outcomes: list[EpisodeOutcome] = []
        self.finished = False  # whether there are no more episodes
        self._start()

    def _start(self) -> None:
        scenario = next(self._scenarios, None)
        if scenario is None:
            self.finished = True
            return
        self._robot.robot.start(scenario)
        self._enter(Phase.HELD, f"episode {scenario.episode} ({scenario.task}): on the gantry")

    def _enter(self, phase: Phase, line: str) -> None:
        self._phase, self._since = phase, 0.0
        if self.outcomes:
            self._robot.pressed = _BUTTONS[phase]
        self._log(line)

    def step(self) -> None:
        """Advance by 5 ms."""
        if self.finished:
            return
        self._robot.step()
        robot = self._robot.robot
        if robot.phase is not self._phase:
            if robot.phase is Phase.OVER:
                self.outcomes.append(robot.outcome)
                line = outcome_text(robot.outcome)
            elif robot.phase is Phase.FREE:
                line = "the gantry releases the robot"
            else:
                line = "the task begins"
            self._enter(robot.phase, line)
        self._since += PHYSICS_DT
        if self._phase is Phase.HELD:
            if not self._robot.commanded:
                self._since = 0.0
            elif self._config.gantry is not None and self._since > self._config.gantry:
                robot.release()
        elif self._phase is Phase.FREE and self._since >= self._config.settle:
            robot.begin()
        elif self._phase is Phase.OVER and self._since >= self._config.pause:
            self._start()


def outcome_text(outcome: EpisodeOutcome) -> str:
    """Describe an outcome in one line."""
    result = "fell" if outcome.fallen else "success" if outcome.success else "failure"
    terms = ", ".join(f"{k} {v:+.3f}" for k, v in outcome.reward_terms.items() if v)
    contacts = ", ".join(f"{part} {force:.0f} N" for part, force in outcome.contacts.items())
    return (
        f"{result} after {outcome.ticks} ticks, reward {outcome.reward:+.3f} "
        f"({terms or 'no terms'}); contacts: {contacts or 'none'}"
    )


class StepPacer:
    """Counts the physics steps (`PHYSICS_DT`) that are due on a clock."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._next_ns = clock.now_ns()

    def wait_for_steps(self) -> int:
        """Sleep until a step is due; returns the number of due steps, at most `_MAX_STEPS`."""
        self._clock.sleep_until(self._next_ns)
        steps = (self._clock.now_ns() - self._next_ns) // _STEP_NS + 1
        self._next_ns += steps * _STEP_NS
        return min(int(steps), _MAX_STEPS)


def outcome_json(outcome: EpisodeOutcome) -> dict[str, Any]:
    """An outcome as JSON."""
    return {
        "task": outcome.scenario.task,
        "episode": outcome.scenario.episode,
        "success": outcome.success,
        "fallen": outcome.fallen,
        "ticks": outcome.ticks,
        "reward": outcome.reward,
        "reward_terms": outcome.reward_terms,
        "contacts_n": outcome.contacts,
    }


def _print(line: str) -> None:
    echo(f"{PROG}: {line}")


if __name__ == "__main__":
    raise SystemExit(main())
