"""Rollouts in lock-step with the planner, of the simulated robot or of recorded observations.

    o_t -> pilot -> planner -> pilot -> a_t -> robot.act -> a_t as sent -> o_{t+1}

With o_{t+1} the planner receives the action that was sent, and advances its recurrence with it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from egovcp.artifact import Artifact
from egovcp.files import user_path, write_json
from egovcp.log.tick import RunInfo, Sink, Tick
from egovcp.rate import NS_PER_S
from egovcp.terminal import echo
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.options import make_output_dir
from egovcp_deploy.pilot.pilot import REJECTED, Pilot
from egovcp_deploy.pilot.planner import (
    SKIPPED,
    InlinePlanner,
    PlannerClient,
    PlannerRunner,
    RolloutPolicy,
    backend_of,
    planner_fields,
)
from egovcp_deploy.pilot.states import Facts, Limits, OperatorRequest, State
from egovcp_deploy.recording import (
    make_run_info,
    open_viewer,
    percentiles,
    provenance_fields,
    recording,
)
from egovcp_deploy.robots.replay import ReplayRobot, open_recordings

if TYPE_CHECKING:
    from egovcp_deploy.robots.sim import SimRobot


@dataclass
class RolloutSummary:
    """Result of one rollout."""

    steps: int = 0
    reward: float = 0.0  # sum over the rollout
    success: bool = False
    parts: Mapping[str, bool] = field(default_factory=dict)  # success of each part of a sequence
    terminated: bool = False
    truncated: bool = False
    rejected: int = 0  # plans that were not finite and were not used
    skipped: int = 0  # observations whose state was not finite, so that the policy did not use them
    held: int = 0  # steps in HOLD
    damped: str = ""  # why the motors were damped; empty: they were not
    plan_ms: list[float] = field(default_factory=list)  # time to filter and plan, per plan

    def add(self, tick: Tick, parts: Mapping[str, bool]) -> None:
        """Add one step."""
        self.steps += 1
        self.reward += tick.reward
        self.success, self.parts = tick.success, parts
        self.terminated, self.truncated = tick.terminated, tick.truncated
        self.rejected += REJECTED in tick.events
        self.skipped += tick.events.count(SKIPPED)
        self.held += tick.mode == State.HOLD
        if "plan" in tick.timing_ms:
            self.plan_ms.append(tick.timing_ms["plan"])


def run_rollout(
    planner: PlannerClient,
    robot: SimRobot | ReplayRobot,
    sink: Sink,
    limits: Limits | None = None,
    on_tick: Callable[[Tick], None] = lambda tick: None,
) -> RolloutSummary:
    """Drive ``robot``, which has started an episode, in simulated time until it ends the rollout;
    ``sink`` is open."""
    period_ns = NS_PER_S // robot.spec.planner_hz
    pilot = Pilot(planner, limits, State.ARMED, robot.spec)
    summary = RolloutSummary()
    while not (summary.terminated or summary.truncated):
        index, now = summary.steps, summary.steps * period_ns
        begin = time.perf_counter()
        sensed = robot.observe()
        observed = time.perf_counter()
        pilot.sense(now, sensed.state, sensed.depth)
        before = pilot.supervisor.state
        state = pilot.update_state(Facts(now), OperatorRequest.RUN if index == 0 else None)
        if index == 0 and state is State.RUN:
            pilot.take_events()  # every simulated rollout starts in RUN: not worth a log line
        if state is State.DAMP and before is not State.DAMP:
            robot.damp()
        pilot.send_observation(now, sensed.depth, sensed.state)
        plan = pilot.receive_plans(now + period_ns)
        planned = time.perf_counter()
        wanted = pilot.next_action()
        outcome = robot.act(wanted)
        pilot.sent = outcome.sent
        timing_ms = {
            "observe": 1e3 * (observed - begin),
            "pilot": 1e3 * (planned - observed),
            "robot": 1e3 * (time.perf_counter() - planned),
        }
        if plan is not None:
            timing_ms["plan"] = plan.plan_ms
        tick = Tick(
            index=index,
            time_ns=now,
            depth=sensed.depth,
            state=sensed.state,
            action_planned=wanted if plan is None else plan.step.action[0],
            action_sent=outcome.sent,
            mode=pilot.supervisor.state,
            reward=outcome.reward,
            reward_terms=outcome.reward_terms,
            terminated=outcome.terminated,
            truncated=outcome.truncated,
            success=outcome.success,
            base=sensed.base,
            scene=sensed.scene,
            events=(*pilot.take_events(), *outcome.events),
            timing_ms=timing_ms,
            **planner_fields(plan, robot.spec),
        )
        sink.write(tick)
        summary.add(tick, outcome.parts)
        on_tick(tick)
    if pilot.supervisor.state is State.DAMP:
        summary.damped = pilot.supervisor.reason
    return summary


def play_rollouts(config: DeployConfig, artifact: Artifact | None) -> Path:
    """Play and record rollouts of the simulated robot; complete ones are summarised in any case.
    Returns the output folder. Raises as `deploy`."""
    from egovcp_deploy.robots.sim import SimRobot  # needs the simulator

    robot = SimRobot(config.env, config.task, config.seed)
    try:
        config = replace(config, env=robot.env.config)  # as resolved for its controller
        policy: RolloutPolicy
        if artifact is None:
            from egovcp_deploy.controllers import ReferencePolicy, reference

            policy = ReferencePolicy(
                reference(config.controller), robot.env, lambda: [robot.scenario]
            )
        else:
            artifact.require_controller(robot.controller_id)
            policy = artifact.make_policy(1, config.seed)
        return _play(config, artifact, robot, policy)
    finally:
        robot.close()


def replay(config: DeployConfig, artifact: Artifact) -> Path:
    """Plan again on recorded observations, of at most ``episodes`` recordings. Returns the output
    folder. Raises as `deploy`, and `DataError` for a damaged recording or another controller."""
    robot = open_recordings(user_path(config.robot.recordings))
    artifact.require_controller(robot.controller_id)
    config = replace(config, episodes=min(config.episodes, len(robot.files)))
    return _play(config, artifact, robot, artifact.make_policy(1, config.seed))


def _play(
    config: DeployConfig,
    artifact: Artifact | None,
    robot: SimRobot | ReplayRobot,
    policy: RolloutPolicy,
) -> Path:
    runner = PlannerRunner(policy, config.imagine)
    if artifact is not None:
        runner.warm_up()
    planner = InlinePlanner(runner)
    folder = make_output_dir(config.output_dir)
    backend = backend_of(policy)
    summaries: list[RolloutSummary] = []
    infos: list[RunInfo] = []
    try:
        with (
            open_viewer(config.log) as viewer,
            tqdm(total=config.episodes, unit="rollout", desc=config.task or "replay") as bar,
        ):
            for episode in range(config.episodes):
                robot.start(episode)
                task, seed, number = config.task, config.seed, episode
                if isinstance(robot, ReplayRobot):
                    task, seed, number = robot.info.task, robot.info.seed, robot.info.episode
                info = replace(
                    make_run_info(config, robot.controller_id, artifact, backend),
                    task=task,
                    seed=seed,
                    episode=number,
                    camera=robot.camera,
                    robot=robot.spec,
                    fps=robot.spec.planner_hz,
                )
                infos.append(info)
                with recording(folder, info, config.log, viewer, True, episode) as sink:
                    summaries.append(
                        run_rollout(planner, robot, sink, config.robot.limits, partial(_show, bar))
                    )
                bar.update(1)
    finally:
        if summaries:
            pairs = enumerate(zip(infos, summaries, strict=False))
            replayed = isinstance(robot, ReplayRobot)  # recordings may differ in task and seed
            report = {
                **({} if replayed else {"task": config.task, "seed": config.seed}),
                "success_rate": float(np.mean([summary.success for summary in summaries])),
                "rollouts": [_row(i, *pair, config.log.rrd) for i, pair in pairs],
                **provenance_fields(info),
            }
            write_json(folder / "deploy.json", report)
            for i, summary in enumerate(summaries):
                verdict = (
                    "success" if summary.success else "fell" if summary.terminated else "failure"
                )
                skipped = f", {summary.skipped} observations skipped" if summary.skipped else ""
                echo(
                    f"rollout {i}: {verdict}, {summary.steps} steps, "
                    f"mean reward {summary.reward / summary.steps:+.4f}, "
                    f"plan {np.median(summary.plan_ms):.0f} ms{skipped}"
                )
                for name, success in summary.parts.items():
                    echo(f"  {name}: {'success' if success else 'failure'}")
    return folder


def _show(bar: Any, tick: Tick) -> None:
    plan = f", plan {tick.timing_ms['plan']:.0f} ms" if "plan" in tick.timing_ms else ""
    bar.set_postfix_str(f"step {tick.index}, {tick.mode}{plan}", refresh=False)
    bar.update(0)


def _row(rollout: int, info: RunInfo, summary: RolloutSummary, rrd: bool) -> dict[str, Any]:
    return {
        "task": info.task,
        "seed": info.seed,
        "episode": info.episode,
        "steps": summary.steps,
        "reward_mean": summary.reward / summary.steps,
        "success": summary.success,
        **({"parts": dict(summary.parts)} if summary.parts else {}),
        "terminated": summary.terminated,
        "rejected_plans": summary.rejected,
        "skipped_observations": summary.skipped,
        "held_ticks": summary.held,
        "damped": summary.damped,
        **percentiles("plan_ms", summary.plan_ms),
        "mcap": f"rollout-{rollout}.mcap",
        **({"rrd": f"rollout-{rollout}.rrd"} if rrd else {}),
    }
