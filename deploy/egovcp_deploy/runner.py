"""The closed loop of one rollout in lock-step: observe, plan, make safe, act, log.

    o_t -> pilot.report -> planner -> pilot.decide -> robot.act -> a_t sent -> o_{t+1}

The planner is told with o_{t+1} what was really sent, and its recurrence advances with that.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from egovcp.log.sink import Sink
from egovcp.log.tick import Candidates, Tick
from egovcp.plan import PolicyStep
from egovcp.rate import FixedRate
from egovcp.spec import ACTION_BOX, ACTION_HANDS
from egovcp_deploy.pilot.desk import SKIPPED, Desk, Reply
from egovcp_deploy.pilot.pilot import REJECTED, Pilot
from egovcp_deploy.pilot.states import Limits, Request, State
from egovcp_deploy.robots.base import ActionResult, LockstepRobot, RobotObservation

LOGGED_CANDIDATES: Final = 32  # best first; more would hide the picture


@dataclass
class RolloutSummary:
    """What came of one rollout."""

    steps: int = 0
    reward: float = 0.0
    """Sum over the rollout."""
    success: bool = False
    terminated: bool = False
    truncated: bool = False
    rejected: int = 0
    """Plans that were not finite and were not used."""
    skipped: int = 0
    """Observations that the policy did not use, because their state was not finite."""
    held: int = 0
    """Ticks on HOLD."""
    damped: str = ""
    """Why the motors were damped; empty: they were not."""
    overruns: int = 0
    """Ticks that took longer than their period."""
    plan_ms: list[float] = field(default_factory=list)
    """Time to filter and plan, per plan."""

    @property
    def over(self) -> bool:
        """Whether the episode has ended by itself."""
        return self.terminated or self.truncated

    def add(self, tick: Tick) -> None:
        """Count one more tick."""
        self.steps += 1
        self.reward += tick.reward
        self.success = tick.success
        self.terminated, self.truncated = tick.terminated, tick.truncated
        self.rejected += REJECTED in tick.events
        self.skipped += tick.events.count(SKIPPED)
        self.held += tick.mode == State.HOLD
        if "plan" in tick.timing_ms:
            self.plan_ms.append(tick.timing_ms["plan"])


class Runner:
    """Drives one robot with one planner.

    Args:
        desk: where the planner is, for one robot.
        robot: in lock-step: time passes in its ``act``.
        rate: paces the loop; its clock gives each tick's time.
        max_ticks: end of a rollout on a robot that knows no time limit.
        limits: of the state machine.
        operator: asked once per tick, with the tick's number, for a request.
    """

    def __init__(
        self,
        desk: Desk,
        robot: LockstepRobot,
        rate: FixedRate,
        max_ticks: int | None = None,
        limits: Limits | None = None,
        operator: Callable[[int], Request | None] = lambda tick: None,
    ) -> None:
        self._robot = robot
        self._rate = rate
        self._max_ticks = max_ticks
        self._operator = operator
        self._pilot = Pilot(desk, limits, State.ARMED)

    def run(
        self, sink: Sink, on_tick: Callable[[Tick], None] = lambda tick: None
    ) -> RolloutSummary:
        """Play the episode that the robot has started; ``sink`` is open."""
        self._pilot.restart()
        self._rate.start()
        begin_ns = self._rate.clock.now_ns()
        summary = RolloutSummary()
        while not summary.over and summary.steps != self._max_ticks:
            tick = self._tick(summary.steps, self._rate.clock.now_ns() - begin_ns)
            sink.write(tick)
            summary.add(tick)
            on_tick(tick)
            summary.overruns += self._rate.wait() > 0
        if self._pilot.supervisor.state is State.DAMP:
            summary.damped = self._pilot.supervisor.reason
        return summary

    def _tick(self, index: int, time_ns: int) -> Tick:
        stopwatch = Stopwatch()
        sensed = self._robot.observe()
        stopwatch.lap("observe")
        reply = self._consult(index, sensed)
        stopwatch.lap("think")
        planned = reply.step.action[0] if reply else None
        wanted = self._pilot.decide()
        outcome = self._robot.act(wanted)
        self._pilot.sent = outcome.sent
        stopwatch.lap("robot")
        timing = dict(stopwatch.laps_ms)
        if reply is not None:
            timing["plan"] = reply.plan_ms
        return Tick(
            index=index,
            time_ns=time_ns,
            depth=sensed.depth,
            state=sensed.state,
            action_planned=wanted if planned is None else planned,
            action_sent=outcome.sent,
            mode=self._pilot.supervisor.state,
            **_outcome(sensed, outcome, (*self._pilot.events(), *outcome.events)),
            **thoughts(reply),
            timing_ms=timing,
        )

    def _consult(self, index: int, sensed: RobotObservation) -> Reply | None:
        """Judge the situation and ask the planner; its reply, if it comes before the tick ends."""
        pilot, now = self._pilot, self._rate.clock.now_ns()
        pilot.sense(now, sensed.state, sensed.depth)
        before = pilot.supervisor.state
        state = pilot.judge(now, Request.RUN if index == 0 else self._operator(index))
        if index == 0 and state is State.RUN:
            pilot.events()  # a simulated robot is always handed over at once: no news
        if state is State.DAMP and before is not State.DAMP:
            self._robot.damp()
        pilot.report(now, sensed.depth, sensed.state)
        return pilot.collect(now + self._rate.period_ns)


class Stopwatch:
    """Durations of consecutive parts of a tick, ms."""

    def __init__(self) -> None:
        self.laps_ms: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """End the part ``name``; the next begins."""
        now = time.perf_counter()
        self.laps_ms[name] = (now - self._last) * 1e3
        self._last = now


def _outcome(
    sensed: RobotObservation, outcome: ActionResult, events: tuple[str, ...]
) -> dict[str, Any]:
    """The fields of `Tick` that the robot fills."""
    return {
        "reward": outcome.reward,
        "reward_terms": outcome.reward_terms,
        "terminated": outcome.terminated,
        "truncated": outcome.truncated,
        "success": outcome.success,
        "base": sensed.base,
        "scene": sensed.scene,
        "events": events,
    }


def thoughts(reply: Reply | None) -> dict[str, Any]:
    """The fields of `Tick` that the planner fills; what it does not know is left out."""
    if reply is None:
        return {}
    step, decoded = reply.step, reply.decoded
    return {
        "depth_reconstructed": decoded.reconstructed,
        "depth_imagined": decoded.imagined,
        "value_maps": decoded.value_maps,
        "plan": step.plan[0] if step.plan.size else None,
        "candidates": _candidates(step) if step.candidates.size else None,
        "value": float(step.value[0]) if step.value.size else None,
        "termination": float(step.termination[0]) if step.termination.size else None,
    }


def _candidates(step: PolicyStep) -> Candidates:
    """The best candidates of the plan as hand paths, m, heading frame."""
    actions = step.candidates[0, :LOGGED_CANDIDATES]  # (n, N, 7)
    hands = ACTION_BOX.to_metric(actions)[..., ACTION_HANDS].reshape(*actions.shape[:2], 2, 3)
    return Candidates(hands, step.candidate_values[0, :LOGGED_CANDIDATES])
