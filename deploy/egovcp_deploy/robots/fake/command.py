"""`egovcp-fake-g1`: the simulated robot on the wall clock, behind the wire of the real one."""

from __future__ import annotations

import os
import queue
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from egovcp.bounds import bounded
from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.outputs import output_file, write_report
from egovcp.rate import NS_PER_S, Clock, MonotonicClock
from egovcp.sim.config import EnvConfig, evaluation_config
from egovcp.sim.live import EpisodeOutcome, LiveRobot
from egovcp.sim.scenario import Scenario
from egovcp.spec import PHYSICS_DT
from egovcp.terminal import echo
from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from egovcp_deploy.robots.fake.faults import WORDS, Faults
from egovcp_deploy.robots.fake.stage import Schedule, Stage
from egovcp_deploy.scenarios import held_out

PROG: Final = "egovcp-fake-g1"
_STEP_NS: Final = round(PHYSICS_DT * NS_PER_S)
_MOST_BEHIND: Final = 20  # steps; what is lost beyond them is lost
_EPILOG: Final = (
    "Speaks LeRobot's JSON over ZMQ for the motors and our own format for depth. Without a command "
    "for 0.2 s its motors damp: its own choice, not the robot's. While it runs it takes words, one "
    f"a line: Enter or release lets the crane go, quit ends it, and {', '.join(WORDS)} make "
    "something go wrong (push 0.5 0, drop 0.3, mode 4, hot_motor left_knee 125, dropped_motor "
    "left_knee, intruder off, heal)."
)


@dataclass(frozen=True)
class FakeConfig:
    """A G1 that is not there, for egovcp-deploy --robot.type=unitree_g1 and for tests.

    Plays held-out scenarios of one task, each from the crane to its outcome.
    """

    task: str = "ball"
    """Scene: ball, wall, arch, or sequence (several in one episode, --env.sequence.parts)."""
    seed: int = bounded(0, least=0)
    """Which held-out scenarios, the same that egovcp-eval plays."""
    episode: int = bounded(0, least=0)
    """Number of the first."""
    episodes: int = bounded(0, least=0, most=1_000_000)
    """How many; 0: until interrupted."""
    gantry: float | None = bounded(3.0, least=0)
    """How long the motors must have been told to hold something, without a break, before the crane
    that holds the pelvis lets go, s; 0: at the first command; null: only on the word release."""
    settle: float = bounded(2.0, least=0)
    """From there to the beginning of the task, s."""
    pause: float = bounded(2.0, least=0)
    """From the end of an episode to the next, which begins on the crane, s; at least 1.5."""
    ports: Ports = field(default_factory=Ports)
    """Where to listen."""
    announce: bool = False
    """Tell in every state how many programs send commands, which LeRobot's bridge does not."""
    detailed: bool = False
    """Tell casing and winding temperatures, status and lost packets of each motor in every state;
    LeRobot's bridge sends one temperature and no status."""
    json: str = output_file()
    """File for the outcomes, rewritten after each episode."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation. The controller only says in which pose to stand
    and whether the arch comes to the robot; the delay of actions is that of the wire."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(FakeConfig, run, argv, prog=PROG, epilog=_EPILOG)


def run(config: FakeConfig, opened: Callable[[Ports], None] = lambda ports: None) -> None:
    """Serve until the episodes are over, or the user has had enough.

    Args:
        config: the options.
        opened: is told where the robot listens, once it does.

    Raises:
        UsageError: an option makes no sense.
        EnvironmentFailure: a port is in use.
    """
    _check(config)
    robot = LiveRobot(config.env)
    robot.start(held_out(config.task, config.seed, config.episode))
    bridge = FakeBridge(robot, config.ports, announce=config.announce, detailed=config.detailed)
    schedule = Schedule(config.gantry, config.settle, config.pause)
    stage = Stage(bridge, _scenarios(config), schedule, _say)
    try:
        opened(bridge.ports)
        _live(config, bridge, stage)
    except KeyboardInterrupt:
        _say("interrupted")
    finally:
        bridge.close()
        _sum_up(stage.outcomes)


def _check(config: FakeConfig) -> None:
    held_out(config.task, config.seed, 0)


def _scenarios(config: FakeConfig) -> Any:
    def scenario(number: int) -> Scenario | None:
        if config.episodes and number >= config.episodes:
            return None
        return held_out(config.task, config.seed, config.episode + number)

    return scenario


def _live(config: FakeConfig, bridge: FakeBridge, stage: Stage) -> None:
    """Keep step with the wall clock."""
    ports = bridge.ports
    _say(
        f"listening on {ports.host}: commands {ports.command_port}, states {ports.state_port}, "
        f"depth {ports.camera_port}; Ctrl-C ends it"
    )
    words, pace, written = Console(), Pace(MonotonicClock()), 0
    while not stage.finished:
        for _ in range(pace.due()):
            stage.step()
        if not words.obeyed(bridge.faults):
            return
        if bridge.faults.die:
            os._exit(1)
        if config.json and len(stage.outcomes) > written:
            written = len(stage.outcomes)
            outcomes = [record(outcome) for outcome in stage.outcomes]
            write_report(config.json, outcomes, durable=False)  # quickly: the robot waits


class Pace:
    """How many steps of 5 ms are due on a clock."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._next_ns = clock.now_ns()

    def due(self) -> int:
        """Sleep until a step is due; how many are, at most `_MOST_BEHIND`."""
        self._clock.sleep_until(self._next_ns)
        steps = (self._clock.now_ns() - self._next_ns) // _STEP_NS + 1
        self._next_ns += steps * _STEP_NS
        return min(int(steps), _MOST_BEHIND)


class Console:
    """Words from the terminal, read by a thread of their own."""

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in sys.stdin:
            self._lines.put(line.strip())

    def obeyed(self, faults: Faults) -> bool:
        """Do what has been said since; false: to end."""
        while not self._lines.empty():
            line = self._lines.get()
            if line == "quit":
                return False
            try:
                _say(faults.obey(line))
            except UsageError as error:
                _say(str(error))
        return True


def record(outcome: EpisodeOutcome) -> dict[str, Any]:
    """An outcome for a JSON file."""
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


def _sum_up(outcomes: Sequence[EpisodeOutcome]) -> None:
    if outcomes:
        won = sum(outcome.success for outcome in outcomes)
        _say(f"{len(outcomes)} episodes, {won} successes")


def _say(line: str) -> None:
    echo(f"{PROG}: {line}")


if __name__ == "__main__":
    raise SystemExit(main())
