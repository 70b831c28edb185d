"""`egovcp-deploy`: close the loop with a policy and record every rollout."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import draccus
import numpy as np
from tqdm import tqdm

from egovcp.artefact import Artefact
from egovcp.cli import run_command
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.log.info import RunInfo
from egovcp.log.mcap import McapSink
from egovcp.log.rerun import RerunSink
from egovcp.log.sink import Fanout, Sink
from egovcp.log.tick import Tick
from egovcp.rate import FixedRate, LockstepClock
from egovcp.sim.config import EnvConfig, eventful
from egovcp.spec import PLANNER_HZ, TASKS
from egovcp_deploy.options import (
    PLANNER,
    REFERENCES,
    PlannerOptions,
    PolicyOptions,
    check_choice,
    check_output_dir,
    check_positive,
    load_policy,
    make_output_dir,
    versions,
    write_json,
)
from egovcp_deploy.pilot.desk import InlineDesk, Thinker
from egovcp_deploy.policy import RolloutPolicy
from egovcp_deploy.robots import Robot
from egovcp_deploy.runner import RolloutSummary, Runner
from egovcp_deploy.scenarios import held_out

if TYPE_CHECKING:
    from egovcp_deploy.robots.sim import SimRobot

PROG: Final = "egovcp-deploy"
ROBOTS: Final = ("sim",)
DRIVERS: Final = (PLANNER, *REFERENCES)
_EPILOG: Final = (
    "Rollout i plays held-out scenario i of --seed, the same that egovcp-eval plays. "
    "Writes rollout-<i>.mcap, rollout-<i>.rrd, a picture rollout-0.png, and deploy.json, which "
    "sums up the rollouts that came to their end, also when the others were interrupted."
)


@dataclass(frozen=True)
class RobotOptions:
    """Which robot."""

    type: str = "sim"
    """sim: the simulated G1, in lock-step with the planner."""


@dataclass(frozen=True)
class DeployConfig:
    """Drive a robot with a policy artefact at 25 Hz and record each rollout.

    --controller=oracle shows how a task is solved, with no artefact at all.
    """

    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """The policy artefact; not needed without the controller `planner`."""
    controller: str = PLANNER
    """Who drives: planner, or in simulation a reference that needs no artefact: hold (neutral
    pose), random (the data's walk) or oracle (scripted, sees the truth)."""
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    """Changes to the artefact's planner."""
    robot: RobotOptions = field(default_factory=RobotOptions)
    """The robot."""
    task: str = "ball"
    """Scene of the simulated robot: ball, wall or arch. The policy is not told."""
    episodes: int = 3
    """Number of rollouts."""
    seed: int = 0
    """Which held-out scenarios."""
    output_dir: str = ""
    """New folder for recordings and summary."""
    imagine: int = 16
    """How far ahead the world model imagines depth for the recordings, ticks of 40 ms; 0: not at
    all."""
    env: EnvConfig = field(default_factory=eventful)
    """Scenes, sensors, delays and randomisation of the simulated robot."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(DeployConfig, deploy, argv, prog=PROG, epilog=_EPILOG)


def deploy(config: DeployConfig) -> None:
    """Check everything, then play and record the rollouts.

    Whatever ends it, an interrupt too, the rollouts that came to their end are summed up.

    Raises:
        UsageError: an option makes no sense, or the folder holds results.
        ArtefactError: the artefact is missing, damaged, or not made for this robot.
    """
    _check(config)
    planned = config.controller == PLANNER
    artefact = load_policy(config.policy, config.planner) if planned else None
    robot = make_robot(config)
    try:
        config = replace(config, env=robot.env.config)  # as decided for its controller
        policy = _make_policy(config, artefact, robot)
        folder = make_output_dir(config.output_dir)
        clock = LockstepClock()
        desk = InlineDesk(Thinker(policy, config.imagine), clock)
        runner = Runner(desk, robot, FixedRate(PLANNER_HZ, clock))
        _play(config, artefact, robot, runner, folder)
    finally:
        robot.close()


def _make_policy(config: DeployConfig, artefact: Artefact | None, robot: SimRobot) -> RolloutPolicy:
    if artefact is None:
        from egovcp_deploy.controllers import Scripted, reference

        return Scripted(reference(config.controller), robot)
    artefact.require_controller(robot.controller_id)
    return artefact.make_policy(1, config.seed)


def _check(config: DeployConfig) -> None:
    check_choice("--task", config.task, TASKS)
    check_choice("--robot.type", config.robot.type, ROBOTS)
    check_positive("--episodes", config.episodes)
    held_out(config.task, config.seed, 0)
    check_choice("--controller", config.controller, DRIVERS)
    if config.controller == PLANNER:
        config.policy.require("choose a reference that needs none, such as --controller=oracle")
    if config.imagine < 0:
        raise UsageError(f"--imagine={config.imagine}: expected a number of ticks from 0")
    check_output_dir(config.output_dir)


def make_robot(config: DeployConfig) -> SimRobot:
    """The robot of ``--robot.type``.

    Raises:
        EnvironmentFailure: the simulator is not installed.
    """
    try:
        from egovcp_deploy.robots.sim import SimRobot
    except ModuleNotFoundError as error:
        raise EnvironmentFailure(
            f"--robot.type=sim needs the simulator, but {error.name} is not installed; "
            "install it: pip install 'egovcp-deploy[sim]'"
        ) from error
    return SimRobot(config.env, config.task, config.seed)


def _play(
    config: DeployConfig, artefact: Artefact | None, robot: Robot, runner: Runner, folder: Path
) -> None:
    """Record one rollout after the other and, whatever ends them, sum up the complete ones."""
    summaries: list[RolloutSummary] = []
    try:
        with tqdm(total=config.episodes, unit="rollout", desc=config.task) as bar:
            for episode in range(config.episodes):
                robot.start(episode)
                info = _run_info(config, artefact, robot, episode)
                with _recording(folder, episode, info) as sink:
                    summaries.append(runner.run(sink, lambda tick: _show(bar, tick)))
                bar.update(1)
    finally:
        if summaries:
            write_json(folder / "deploy.json", _report(config, artefact, robot, summaries))
            _print(summaries, folder)


@contextmanager
def _recording(folder: Path, episode: int, info: RunInfo) -> Iterator[Sink]:
    """Sinks of one rollout; the first rollout leaves a picture too."""
    stem = folder / f"rollout-{episode}"
    sinks: list[Sink] = [McapSink(stem.with_suffix(".mcap")), RerunSink(stem.with_suffix(".rrd"))]
    if episode == 0 and importlib.util.find_spec("matplotlib") is not None:
        from egovcp.log.picture import PictureSink

        sinks.append(PictureSink(stem.with_suffix(".png")))
    with Fanout(sinks) as sink:
        sink.open(info)
        yield sink


def _run_info(
    config: DeployConfig, artefact: Artefact | None, robot: Robot, episode: int
) -> RunInfo:
    files = artefact.manifest["files"] if artefact else {}
    return RunInfo(
        task=config.task,
        seed=config.seed,
        episode=episode,
        camera=robot.camera,
        config=draccus.encode(config),
        hashes={"low_level_controller": robot.controller_id, **files},
        versions=versions(),
    )


def _show(bar: Any, tick: Tick) -> None:
    plan = f", plan {tick.timing_ms['plan']:.0f} ms" if "plan" in tick.timing_ms else ""
    bar.set_postfix_str(f"tick {tick.index}, {tick.mode}{plan}", refresh=False)
    bar.update(0)


def _report(
    config: DeployConfig,
    artefact: Artefact | None,
    robot: Robot,
    summaries: Sequence[RolloutSummary],
) -> dict[str, Any]:
    """Content of ``deploy.json``."""
    return {
        "task": config.task,
        "seed": config.seed,
        "success_rate": float(np.mean([summary.success for summary in summaries])),
        "rollouts": [_row(i, summary) for i, summary in enumerate(summaries)],
        "config": draccus.encode(config),
        "artefact": artefact.manifest["files"] if artefact else None,
        "low_level_controller": robot.controller_id,
        "versions": versions(),
    }


def _row(episode: int, summary: RolloutSummary) -> dict[str, Any]:
    p50, p99 = np.percentile(summary.plan_ms or [0.0], [50, 99])
    return {
        "episode": episode,
        "steps": summary.steps,
        "reward_mean": summary.reward / summary.steps,
        "success": summary.success,
        "terminated": summary.terminated,
        "rejected_plans": summary.rejected,
        "held_ticks": summary.held,
        "damped": summary.damped,
        "overruns": summary.overruns,
        "plan_ms_p50": float(p50),
        "plan_ms_p99": float(p99),
        "mcap": f"rollout-{episode}.mcap",
        "rrd": f"rollout-{episode}.rrd",
    }


def _print(summaries: Sequence[RolloutSummary], folder: Path) -> None:
    for i, summary in enumerate(summaries):
        verdict = "success" if summary.success else "fell" if summary.terminated else "failure"
        print(
            f"rollout {i}: {verdict}, {summary.steps} ticks, "
            f"mean reward {summary.reward / summary.steps:+.4f}, "
            f"plan {np.median(summary.plan_ms):.0f} ms"
        )
    print(f"look at it:  rerun {folder / 'rollout-0.rrd'}")


if __name__ == "__main__":
    raise SystemExit(main())
