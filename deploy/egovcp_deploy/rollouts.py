"""Rollouts of the simulated robot, in lock-step with the planner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from egovcp.artifact import Artifact
from egovcp.files import write_json
from egovcp.log.tick import RunInfo, Tick
from egovcp.rate import FixedRate, LockstepClock
from egovcp.spec import PLANNER_HZ
from egovcp.terminal import echo
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.options import make_output_dir, versions
from egovcp_deploy.pilot.desk import InlineDesk, Thinker
from egovcp_deploy.policy import RolloutPolicy, backend_of
from egovcp_deploy.recording import recording, run_info
from egovcp_deploy.robots import LockstepRobot
from egovcp_deploy.robots.replay import open_recordings
from egovcp_deploy.runner import RolloutSummary, Runner

if TYPE_CHECKING:
    from egovcp_deploy.robots.sim import SimRobot


def play_rollouts(config: DeployConfig, artifact: Artifact | None) -> None:
    """Play and record; whatever ends it, the rollouts that came to their end are summed up.

    Raises:
        ArtifactError: the artifact is not made for this robot.
        EnvironmentFailure: the simulator is not installed.
    """
    robot = make_robot(config)
    try:
        config = replace(config, env=robot.env.config)  # as decided for its controller
        _play(config, artifact, robot, _make_policy(config, artifact, robot))
    finally:
        robot.close()


def replay(config: DeployConfig, artifact: Artifact) -> None:
    """Let the policy watch what was recorded; at most ``episodes`` of the recordings.

    Raises:
        ArtifactError: the artifact is not made for the robot that was recorded.
        UsageError, DataError: there is nothing to play back, or it is damaged.
    """
    robot = open_recordings(Path(config.robot.recordings))
    artifact.require_controller(robot.controller_id)
    config = replace(config, episodes=min(config.episodes, robot.count))
    _play(config, artifact, robot, artifact.make_policy(1, config.seed))


def _make_policy(config: DeployConfig, artifact: Artifact | None, robot: SimRobot) -> RolloutPolicy:
    if artifact is None:
        from egovcp_deploy.controllers import Scripted, reference

        return Scripted(reference(config.controller), robot)
    artifact.require_controller(robot.controller_id)
    return artifact.make_policy(1, config.seed)


def make_robot(config: DeployConfig) -> SimRobot:
    """The robot of ``--robot.type=sim``; importing it needs the simulator."""
    from egovcp_deploy.robots.sim import SimRobot

    return SimRobot(config.env, config.task, config.seed)


def _play(
    config: DeployConfig, artifact: Artifact | None, robot: LockstepRobot, policy: RolloutPolicy
) -> None:
    """Record one rollout after the other and, whatever ends them, sum up the complete ones."""
    thinker = Thinker(policy, config.imagine)
    if artifact is not None:
        thinker.warm_up()
    folder = make_output_dir(config.output_dir)
    clock = LockstepClock()
    desk = InlineDesk(thinker, clock)
    backend = backend_of(policy)
    runner = Runner(desk, robot, FixedRate(PLANNER_HZ, clock), limits=config.robot.limits)
    summaries: list[RolloutSummary] = []
    try:
        with tqdm(total=config.episodes, unit="rollout", desc=config.task) as bar:
            for episode in range(config.episodes):
                robot.start(episode)
                info = _info(config, artifact, robot, episode, backend)
                with recording(folder, episode, info, config.log, waits=True) as sink:
                    summaries.append(runner.run(sink, lambda tick: _show(bar, tick)))
                bar.update(1)
    finally:
        if summaries:
            report = _report(config, artifact, robot, backend, summaries)
            write_json(folder / "deploy.json", report)
            _print(summaries, folder)


def _info(
    config: DeployConfig,
    artifact: Artifact | None,
    robot: LockstepRobot,
    episode: int,
    backend: str,
) -> RunInfo:
    return run_info(
        config.task,
        config.seed,
        episode,
        robot.camera,
        config.encoded(),
        robot.controller_id,
        artifact,
        backend,
    )


def _show(bar: Any, tick: Tick) -> None:
    plan = f", plan {tick.timing_ms['plan']:.0f} ms" if "plan" in tick.timing_ms else ""
    bar.set_postfix_str(f"tick {tick.index}, {tick.mode}{plan}", refresh=False)
    bar.update(0)


def _report(
    config: DeployConfig,
    artifact: Artifact | None,
    robot: LockstepRobot,
    backend: str,
    summaries: Sequence[RolloutSummary],
) -> dict[str, Any]:
    """Content of ``deploy.json``."""
    return {
        "task": config.task,
        "seed": config.seed,
        "success_rate": float(np.mean([summary.success for summary in summaries])),
        "rollouts": [_row(i, summary) for i, summary in enumerate(summaries)],
        "config": config.encoded(),
        "artifact": artifact.manifest["files"] if artifact else None,
        "low_level_controller": robot.controller_id,
        "backend": backend,
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
        "skipped_observations": summary.skipped,
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
        echo(
            f"rollout {i}: {verdict}, {summary.steps} ticks, "
            f"mean reward {summary.reward / summary.steps:+.4f}, "
            f"plan {np.median(summary.plan_ms):.0f} ms"
            + (f", {summary.skipped} observations skipped" if summary.skipped else "")
        )
    echo(f"look at it:  rerun {folder / 'rollout-0.rrd'}")
