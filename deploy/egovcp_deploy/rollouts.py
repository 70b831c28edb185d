"""Rollouts in lock-step with the planner, of the simulated robot or of recorded observations.

    o_t -> pilot -> planner -> pilot -> a_t -> robot.act -> a_t as sent -> o_{t+1}

With o_{t+1} the planner receives the action that was sent, and advances its recurrence with it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from egovcp.artifact import Artifact
from egovcp.files import write_json
from egovcp.log.tick import Sink, Tick
from egovcp.rate import NS_PER_S
from egovcp.terminal import echo
from egovcp_deploy.config import DeployConfig
from egovcp_deploy.options import make_output_dir
from egovcp_deploy.pilot.pilot import REJECTED, Pilot
from egovcp_deploy.pilot.planner import (
    SKIPPED,
    InlinePlanner,
    PlanMessage,
    PlannerClient,
    PlannerRunner,
    RolloutPolicy,
    backend_of,
    planner_fields,
)
from egovcp_deploy.pilot.states import Facts, Limits, OperatorRequest, State
from egovcp_deploy.recording import open_viewer, percentiles, provenance, recording, run_info
from egovcp_deploy.robots.base import RobotObservation
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

    def add(self, tick: Tick) -> None:
        """Add one step."""
        self.steps += 1
        self.reward += tick.reward
        self.success = tick.success
        self.terminated, self.truncated = tick.terminated, tick.truncated
        self.rejected += REJECTED in tick.events
        self.skipped += tick.events.count(SKIPPED)
        self.held += tick.mode == State.HOLD
        if "plan" in tick.timing_ms:
            self.plan_ms.append(tick.timing_ms["plan"])


class LockstepRunner:
    """Drives one robot with one planner in simulated time, until the robot ends the rollout."""

    def __init__(
        self, planner: PlannerClient, robot: SimRobot | ReplayRobot, limits: Limits | None = None
    ) -> None:
        self._planner, self._robot, self._limits = planner, robot, limits

    def run(
        self, sink: Sink, on_tick: Callable[[Tick], None] = lambda tick: None
    ) -> RolloutSummary:
        """Play the episode that the robot has started; ``sink`` is open."""
        self._period_ns = NS_PER_S // self._robot.spec.planner_hz
        self._pilot = Pilot(self._planner, self._limits, State.ARMED, self._robot.spec)
        summary = RolloutSummary()
        while not (summary.terminated or summary.truncated):
            tick = self._tick(summary.steps)
            sink.write(tick)
            summary.add(tick)
            summary.parts = self._parts
            on_tick(tick)
        if self._pilot.supervisor.state is State.DAMP:
            summary.damped = self._pilot.supervisor.reason
        return summary

    def _tick(self, index: int) -> Tick:
        begin = time.perf_counter()
        sensed = self._robot.observe()
        observed = time.perf_counter()
        plan = self._plan(index, sensed)
        planned = time.perf_counter()
        wanted = self._pilot.next_action()
        outcome = self._robot.act(wanted)
        self._pilot.sent, self._parts = outcome.sent, outcome.parts
        ended = time.perf_counter()
        timing = {
            "observe": observed - begin,
            "think": planned - observed,
            "robot": ended - planned,
        }
        timing_ms = {name: 1e3 * seconds for name, seconds in timing.items()}
        if plan is not None:
            timing_ms["plan"] = plan.plan_ms
        return Tick(
            index=index,
            time_ns=index * self._period_ns,
            depth=sensed.depth,
            state=sensed.state,
            action_planned=wanted if plan is None else plan.step.action[0],
            action_sent=outcome.sent,
            mode=self._pilot.supervisor.state,
            reward=outcome.reward,
            reward_terms=outcome.reward_terms,
            terminated=outcome.terminated,
            truncated=outcome.truncated,
            success=outcome.success,
            base=sensed.base,
            scene=sensed.scene,
            events=(*self._pilot.take_events(), *outcome.events),
            timing_ms=timing_ms,
            **planner_fields(plan, self._robot.spec),
        )

    def _plan(self, index: int, sensed: RobotObservation) -> PlanMessage | None:
        """Update the state machine and plan; None: no plan within the step."""
        pilot, now = self._pilot, index * self._period_ns
        pilot.sense(now, sensed.state, sensed.depth)
        before = pilot.supervisor.state
        state = pilot.update_state(Facts(now), OperatorRequest.RUN if index == 0 else None)
        if index == 0 and state is State.RUN:
            pilot.take_events()  # every simulated rollout starts in RUN: not worth a log line
        if state is State.DAMP and before is not State.DAMP:
            self._robot.damp()
        pilot.send_observation(now, sensed.depth, sensed.state)
        return pilot.receive_plans(now + self._period_ns)


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
    folder. Raises as `deploy`, and `DataError` if a recording is damaged."""
    robot = open_recordings(Path(config.robot.recordings))
    artifact.require_controller(robot.controller_id)
    config = replace(config, episodes=min(config.episodes, robot.count))
    return _play(config, artifact, robot, artifact.make_policy(1, config.seed))


def _play(
    config: DeployConfig,
    artifact: Artifact | None,
    robot: SimRobot | ReplayRobot,
    policy: RolloutPolicy,
) -> Path:
    planner = PlannerRunner(policy, config.imagine)
    if artifact is not None:
        planner.warm_up()
    folder = make_output_dir(config.output_dir)
    backend = backend_of(policy)
    runner = LockstepRunner(InlinePlanner(planner), robot, config.robot.limits)
    summaries: list[RolloutSummary] = []
    try:
        with (
            open_viewer(config.log) as viewer,
            tqdm(total=config.episodes, unit="rollout", desc=config.task) as bar,
        ):
            for episode in range(config.episodes):
                robot.start(episode)
                info = run_info(
                    config,
                    robot.controller_id,
                    artifact,
                    backend,
                    episode,
                    robot.camera,
                    robot.spec,
                )
                with recording(folder, episode, info, config.log, viewer, blocking=True) as sink:
                    summaries.append(runner.run(sink, lambda tick: _show(bar, tick)))
                bar.update(1)
    finally:
        if summaries:
            report = {
                "task": config.task,
                "seed": config.seed,
                "success_rate": float(np.mean([summary.success for summary in summaries])),
                "rollouts": [_row(i, summary) for i, summary in enumerate(summaries)],
                **provenance(config, robot.controller_id, artifact, backend),
            }
            write_json(folder / "deploy.json", report)
            _print(summaries)
    return folder


def _show(bar: Any, tick: Tick) -> None:
    plan = f", plan {tick.timing_ms['plan']:.0f} ms" if "plan" in tick.timing_ms else ""
    bar.set_postfix_str(f"step {tick.index}, {tick.mode}{plan}", refresh=False)
    bar.update(0)


def _row(episode: int, summary: RolloutSummary) -> dict[str, Any]:
    return {
        "episode": episode,
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
        "mcap": f"rollout-{episode}.mcap",
        "rrd": f"rollout-{episode}.rrd",
    }


def _print(summaries: Sequence[RolloutSummary]) -> None:
    for i, summary in enumerate(summaries):
        verdict = "success" if summary.success else "fell" if summary.terminated else "failure"
        echo(
            f"rollout {i}: {verdict}, {summary.steps} steps, "
            f"mean reward {summary.reward / summary.steps:+.4f}, "
            f"plan {np.median(summary.plan_ms):.0f} ms"
            + (f", {summary.skipped} observations skipped" if summary.skipped else "")
        )
        for name, success in summary.parts.items():
            echo(f"  {name}: {'success' if success else 'failure'}")
