"""`egovcp-fake-g1`: a simulated G1 in real time behind the protocol of LeRobot's bridge."""

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
from egovcp_deploy.options import held_out
from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from egovcp_deploy.robots.fake.episodes import EpisodeSchedule, EpisodeSequencer
from egovcp_deploy.robots.fake.faults import FAULT_COMMANDS, InjectedFaults

PROG: Final = "egovcp-fake-g1"
_STEP_NS: Final = round(PHYSICS_DT * NS_PER_S)
_MAX_STEPS: Final = 20  # caught up after a delay; the rest are dropped
_EPILOG: Final = (
    "Motors use LeRobot's JSON over ZMQ, depth the format of egovcp-depth-server. Without a "
    "command for 0.2 s the motors damp, which a real robot does not do. While it runs it reads "
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

    task: str = "ball"
    """Scene: ball, wall, arch, or sequence (several in one episode, --env.sequence.parts)."""
    seed: int = bounded(0, least=0)
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
    pause: float = bounded(2.0, least=0)
    """Time between the end of an episode and the next, which starts on the gantry, s; at least
    1.5."""
    ports: Ports = field(default_factory=Ports)
    """Where to listen."""
    announce: bool = False
    """Report in every state how many programs send commands, which LeRobot's bridge does not."""
    detailed: bool = False
    """Report casing and winding temperatures, status and lost packets of each motor in every state;
    LeRobot's bridge sends one temperature and no status."""
    json: str = output_file()
    """File for the outcomes, rewritten after each episode."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation. The controller only selects the pose to stand in
    and whether the arch comes to the robot; the delay of actions is that of the connection."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(FakeG1Config, run, argv, prog=PROG, epilog=_EPILOG)


def run(config: FakeG1Config, opened: Callable[[Ports], None] = lambda ports: None) -> None:
    """Serve until the episodes are over or the user ends it.

    Args:
        config: the options.
        opened: called with the ports once the robot listens.

    Raises:
        UsageError: an option is invalid.
        EnvironmentFailure: a port is in use.
    """
    first = held_out(config.task, config.seed, config.episode)
    robot = LiveRobot(config.env)
    robot.start(first)

    def scenario(number: int) -> Scenario | None:
        if config.episodes and number >= config.episodes:
            return None
        return held_out(config.task, config.seed, config.episode + number)

    bridge = FakeBridge(robot, config.ports, announce=config.announce, detailed=config.detailed)
    schedule = EpisodeSchedule(config.gantry, config.settle, config.pause)
    episodes = EpisodeSequencer(bridge, scenario, schedule, _print)
    try:
        opened(bridge.ports)
        _serve(config, bridge, episodes)
    except KeyboardInterrupt:
        _print("interrupted")
    finally:
        bridge.close()
        if outcomes := episodes.outcomes:
            successes = sum(outcome.success for outcome in outcomes)
            _print(f"{len(outcomes)} episodes, {successes} successes")


def _serve(config: FakeG1Config, bridge: FakeBridge, episodes: EpisodeSequencer) -> None:
    """Step in real time."""
    ports = bridge.ports
    _print(
        f"listening on {ports.host}: commands {ports.command_port}, states {ports.state_port}, "
        f"depth {ports.camera_port}; Ctrl-C ends it"
    )
    console, pacer, written = Console(), StepPacer(MonotonicClock()), 0
    while not episodes.finished:
        for _ in range(pacer.wait_for_steps()):
            episodes.step()
        if not console.process(bridge.faults):
            return
        if bridge.faults.crash:
            os._exit(1)
        if config.json and len(episodes.outcomes) > written:
            written = len(episodes.outcomes)
            report = [outcome_json(outcome) for outcome in episodes.outcomes]
            write_report(config.json, report, durable=False)  # an fsync would delay the robot


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


class Console:
    """Commands from the terminal, read in a thread."""

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in sys.stdin:
            self._lines.put(line.strip())

    def process(self, faults: InjectedFaults) -> bool:
        """Execute the commands since the last call; returns False on `quit`."""
        while not self._lines.empty():
            line = self._lines.get()
            if line == "quit":
                return False
            try:
                _print(faults.apply(line))
            except UsageError as error:
                _print(str(error))
        return True


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
