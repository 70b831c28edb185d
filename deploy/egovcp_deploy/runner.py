"""The closed loop of one rollout: observe, filter and plan, make safe, act, log.

    o_t -> policy.act -> a_t planned -> safety -> robot.act -> a_t sent -> policy.advance

The recurrence of the world model advances with the action that was really sent.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovcp.log.sink import Sink
from egovcp.log.tick import Candidates, Tick
from egovcp.plan import PolicyStep
from egovcp.rate import FixedRate
from egovcp.spec import ACTION_BOX
from egovcp_deploy.policy import ImaginingPolicy, RolloutPolicy
from egovcp_deploy.robots.base import Outcome, Robot, Sensed
from egovcp_deploy.safety import SafetyFilter

LOGGED_CANDIDATES: Final = 32  # best first; more would hide the picture
REJECTED: Final = "plan rejected: not finite"


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
    """Plans that were not finite and were replaced."""
    overruns: int = 0
    """Ticks that took longer than their period."""
    plan_ms: list[float] = field(default_factory=list)
    """Time to filter and plan, per tick."""

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
        self.plan_ms.append(tick.timing_ms["plan"])


class Runner:
    """Drives one robot with one policy.

    Args:
        policy: decides for one robot.
        robot: lock-step simulation or hardware.
        rate: paces the loop; its clock gives each tick's time.
        imagine: how many ticks ahead to decode for the log, of a policy that can imagine; 0
            decodes nothing.
        max_ticks: end of a rollout on a robot that knows no time limit.
    """

    def __init__(
        self,
        policy: RolloutPolicy,
        robot: Robot,
        rate: FixedRate,
        imagine: int = 16,
        max_ticks: int | None = None,
    ) -> None:
        self._policy = policy
        self._robot = robot
        self._rate = rate
        self._imagine = imagine
        self._imagining = policy if imagine and isinstance(policy, ImaginingPolicy) else None
        self._max_ticks = max_ticks
        self._safety = SafetyFilter()

    def run(
        self, sink: Sink, on_tick: Callable[[Tick], None] = lambda tick: None
    ) -> RolloutSummary:
        """Play the episode that the robot has started; ``sink`` is open."""
        self._policy.reset()
        self._safety.reset()
        self._rate.start()
        begin_ns = self._rate.clock.now_ns()
        summary = RolloutSummary()
        while not summary.over and summary.steps != self._max_ticks:
            tick = self._tick(summary.steps, self._rate.clock.now_ns() - begin_ns)
            sink.write(tick)
            summary.add(tick)
            on_tick(tick)
            summary.overruns += self._rate.wait() > 0
        return summary

    def _tick(self, index: int, time_ns: int) -> Tick:
        stopwatch = Stopwatch()
        sensed = self._robot.observe()
        stopwatch.lap("observe")
        step = self._policy.act(sensed.depth[None], sensed.state[None])
        stopwatch.lap("plan")
        decoded = self._decode(step)
        stopwatch.lap("decode")
        safe = self._safety.filter(step.action)
        outcome = self._robot.act(safe.action[0])
        self._policy.advance(outcome.sent[None])
        stopwatch.lap("robot")
        events = (*outcome.events, *((REJECTED,) if safe.rejected[0] else ()))
        seen = _Moment(index, time_ns, sensed, step, decoded, outcome, events, stopwatch.laps_ms)
        return seen.tick()

    def _decode(self, step: PolicyStep) -> _Decoded:
        """Pictures for the log. They come before the carry advances, for they show o_t."""
        if self._imagining is None:
            return _Decoded(None, None)
        film = self._imagining.imagine(step.plan, self._imagine)
        return _Decoded(self._imagining.reconstruct()[0], film[0])


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


class _Decoded(NamedTuple):
    """Depth pictures decoded for the log, m."""

    reconstructed: NDArray[np.float32] | None
    imagined: NDArray[np.float32] | None


@dataclass(frozen=True)
class _Moment:
    """The parts that make a `Tick`."""

    index: int
    time_ns: int
    sensed: Sensed
    step: PolicyStep
    decoded: _Decoded
    outcome: Outcome
    events: tuple[str, ...]
    timing_ms: dict[str, float]

    def tick(self) -> Tick:
        step, outcome = self.step, self.outcome
        return Tick(
            index=self.index,
            time_ns=self.time_ns,
            depth=self.sensed.depth,
            state=self.sensed.state,
            action_planned=step.action[0],
            action_sent=outcome.sent,
            depth_reconstructed=self.decoded.reconstructed,
            depth_imagined=self.decoded.imagined,
            plan=step.plan[0] if step.plan.size else None,
            candidates=_candidates(step) if step.candidates.size else None,
            value=float(step.value[0]) if step.value.size else None,
            termination=float(step.termination[0]) if step.termination.size else None,
            reward=outcome.reward,
            reward_terms=outcome.reward_terms,
            terminated=outcome.terminated,
            truncated=outcome.truncated,
            success=outcome.success,
            timing_ms=self.timing_ms,
            base=self.sensed.base,
            scene=self.sensed.scene,
            events=self.events,
        )


def _candidates(step: PolicyStep) -> Candidates:
    """The best candidates of the plan as hand paths, m, heading frame."""
    actions = step.candidates[0, :LOGGED_CANDIDATES]  # (n, N, 7)
    hands = ACTION_BOX.to_metric(actions)[..., :6].reshape(*actions.shape[:2], 2, 3)
    return Candidates(hands, step.candidate_values[0, :LOGGED_CANDIDATES])
