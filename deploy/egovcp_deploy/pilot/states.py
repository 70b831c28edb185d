"""The safety state machine of a driven robot, a pure function of measured facts.

    INIT -> STAND -> ARMED -> RUN <-> HOLD          any -> DAMP, latched

In DAMP a standing robot collapses to the floor, so it is reserved for what standing cannot
survive: lost proprioception, a controller without finite targets, a motor that dropped out, another
mode machine, a fall, an emergency stop.
A robot without planner or camera can still stand: that is HOLD.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

from egovcp.bounds import bounded


class State(StrEnum):
    """What the robot is doing."""

    INIT = "init"  # motors damped until the first readings arrive
    STAND = "stand"  # the gains ramp in and the controller moves the robot to its stance
    ARMED = "armed"  # stands in the neutral pose; plans are computed but not executed
    RUN = "run"  # executes the planner's actions
    HOLD = "hold"  # stands; the hands ease to neutral, the velocity to zero
    DAMP = "damp"  # motors damped until the program is started again


class OperatorRequest(StrEnum):
    """A state change that the operator requests."""

    STAND = "stand"
    ARM = "arm"
    RUN = "run"
    HOLD = "hold"
    ESTOP = "estop"


class OperatorCommand(NamedTuple):
    """One input of the operator."""

    request: OperatorRequest | None = None
    velocity: tuple[float, float, float] | None = None  # m/s, m/s, rad/s; None: unchanged
    quit: bool = False  # end the control process; it damps the motors first


@dataclass(frozen=True)
class Limits:
    """Thresholds for HOLD and DAMP, and the times of recovery and standing up."""

    state_hold_s: float = bounded(0.1, above=0)
    """HOLD when proprioception is older, s."""
    state_damp_s: float = bounded(0.2, above=0)
    """DAMP when proprioception is older, s. Above 0.5, readings first rejected as implausible are
    accepted again before DAMP if they are consistent."""
    image_hold_s: float = bounded(0.2, above=0)
    """HOLD when the depth image is older, s."""
    planner_hold_s: float = bounded(0.14, above=0)
    """HOLD when an observation has waited longer for its plan, s."""
    misses_hold: int = bounded(5, least=0, most=10_000)
    """HOLD after more consecutive ticks without a plan in time."""
    tilt_damp: float = bounded(1.0, above=0, most=math.pi / 2)
    """DAMP beyond this angle between pelvis and vertical, rad."""
    height_damp: float = bounded(0.40, least=0)
    """DAMP below this height of the pelvis above the lower foot, m; the lowest stance has 0.5."""
    recover_s: float = bounded(1.0, least=0)
    """HOLD ends after this time without a fault, s."""
    stand_s: float = bounded(3.0, above=0)
    """Time in which STAND ramps up the gains, s."""


@dataclass(frozen=True)
class Facts:
    """Inputs of the state machine at one control tick."""

    time_ns: int  # now, monotonic
    state_age_s: float = 0.0  # time since proprioception last changed
    image_age_s: float = 0.0  # time since the depth image last changed
    planner_silence_s: float = 0.0  # age of the oldest observation without a plan
    misses: int = 0  # consecutive ticks without a plan in time
    tilt: float = 0.0  # angle between pelvis and vertical, rad
    height: float = 0.74  # pelvis above the lower foot, m
    controller_ok: bool = True  # whether the last targets of the low-level controller were finite
    planner_alive: bool = True  # false once the planner is known to have ended
    refusal: str = ""  # why the robot must not be armed; empty: no reason
    hold: str = ""  # why another check requires HOLD; empty: no reason
    damp: str = ""  # why another check requires DAMP; empty: no reason
    skipped: str = ""  # fault of the readings rejected since the last valid one; empty: none


_REQUESTED: Final = "requested by the operator"
_TRANSITIONS: Final = {
    OperatorRequest.STAND: (State.INIT, State.STAND),
    OperatorRequest.ARM: (State.STAND, State.ARMED),
    OperatorRequest.RUN: (State.ARMED, State.RUN),
}


class Supervisor:
    """Holds the state; call `update` at every control tick. A simulated robot that stands already
    begins in ARMED."""

    def __init__(self, limits: Limits | None = None, state: State = State.INIT) -> None:
        self.limits = limits or Limits()
        self.state = state
        self.reason = "start"  # why the machine is in this state
        self._since_ns: int | None = None
        self._healthy_since_ns: int | None = None
        self._hold_requested = False

    def update(self, facts: Facts, request: OperatorRequest | None = None) -> tuple[str, ...]:
        """Apply ``facts`` and the operator's ``request``; returns log lines of what changed."""
        if self._since_ns is None:
            self._since_ns = facts.time_ns
        before, self._events = self.state, list[str]()
        if self.state is not State.DAMP:
            self._step(facts, request)
        elif request in _TRANSITIONS:
            self._refuse(request, "the motors stay damped; start the program again")
        if self.state is not before:
            self._events.append(f"{before} -> {self.state}: {self.reason}")
        return tuple(self._events)

    def time_in_state_s(self, now_ns: int) -> float:
        """Time since the state was entered, s."""
        return 0.0 if self._since_ns is None else (now_ns - self._since_ns) / 1e9

    def _step(self, facts: Facts, request: OperatorRequest | None) -> None:
        if request is OperatorRequest.ESTOP:
            self._enter(State.DAMP, "emergency stop", facts)
        elif self.state is not State.INIT and (reason := self._damp_reason(facts)):
            self._enter(State.DAMP, reason, facts)
        elif self.state in (State.RUN, State.HOLD):
            self._run_or_hold(facts, request)
        elif request is not None:
            self._advance(facts, request)

    def _damp_reason(self, facts: Facts) -> str:
        limits = self.limits
        if facts.damp:
            return facts.damp
        if facts.state_age_s > limits.state_damp_s:
            return _stale_state(facts)
        if not facts.controller_ok:
            return "the targets of the low-level controller are not finite"
        if not facts.tilt <= limits.tilt_damp:
            return f"the pelvis is tilted by {facts.tilt:.2f} rad"
        if self.state is not State.STAND and not facts.height >= limits.height_damp:
            return f"the pelvis is {facts.height:.2f} m above the foot"
        return ""

    def _hold_reason(self, facts: Facts) -> str:
        limits = self.limits
        if facts.hold:
            return facts.hold
        if not facts.planner_alive:
            return "the planner has ended"
        if facts.planner_silence_s > limits.planner_hold_s:
            return f"the planner has not answered for {facts.planner_silence_s * 1e3:.0f} ms"
        if facts.misses > limits.misses_hold:
            return f"{facts.misses} ticks in a row without a plan in time"
        if facts.state_age_s > limits.state_hold_s:
            return _stale_state(facts)
        if facts.image_age_s > limits.image_hold_s:
            return f"no new depth image for {facts.image_age_s * 1e3:.0f} ms"
        return ""

    def _run_or_hold(self, facts: Facts, request: OperatorRequest | None) -> None:
        fault = self._hold_reason(facts)
        if request is OperatorRequest.HOLD:
            if self.state is State.HOLD and not self._hold_requested:
                self._events.append("hold requested by the operator")
            self._hold_requested = True
        elif request is OperatorRequest.RUN and self.state is State.HOLD:
            self._hold_requested = False
            now = f"; now: {fault}" if fault else ""
            follows = f"RUN follows {self.limits.recover_s:g} s without a fault"
            self._events.append(f"run requested; {follows}{now}")
        elif request is not None:
            self._refuse(request, f"the robot is in {self.state}")
        if reason := _REQUESTED if self._hold_requested else fault:
            self._healthy_since_ns = None
            self._enter(State.HOLD, reason, facts)
        elif self.state is State.HOLD:
            self._recover(facts)

    def _refuse(self, request: OperatorRequest, objection: str) -> None:
        self._events.append(f"{request} refused: {objection}")

    def _recover(self, facts: Facts) -> None:
        """Return to RUN after `Limits.recover_s` without a fault, so that the state does not
        flicker. One late plan is bridged by the plan before it and is not a fault."""
        if facts.misses > 1:
            self._healthy_since_ns = None
            return
        if self._healthy_since_ns is None:
            self._healthy_since_ns = facts.time_ns
        if facts.time_ns - self._healthy_since_ns >= self.limits.recover_s * 1e9:
            self._enter(State.RUN, f"no fault for {self.limits.recover_s:g} s", facts)

    def _advance(self, facts: Facts, request: OperatorRequest) -> None:
        """One step of INIT -> STAND -> ARMED -> RUN, if it is the next one and nothing objects."""
        if request is OperatorRequest.HOLD:
            return
        source, target = _TRANSITIONS[request]
        if source is not self.state:
            self._refuse(request, f"the robot is in {self.state}")
        elif objection := self._objection(facts, request):
            self._refuse(request, objection)
        else:
            self._hold_requested = False
            self._enter(target, _REQUESTED, facts)

    def _objection(self, facts: Facts, request: OperatorRequest) -> str:
        if facts.state_age_s > self.limits.state_hold_s:
            return "proprioception is not fresh"
        if facts.refusal:
            return facts.refusal
        if request is OperatorRequest.ARM:
            left = self.limits.stand_s - self.time_in_state_s(facts.time_ns)
            if left > 0:
                return f"still standing up, {left:.1f} s to go"
            if facts.height < self.limits.height_damp:
                return f"the pelvis is only {facts.height:.2f} m above the foot"
        return self._hold_reason(facts) if request is OperatorRequest.RUN else ""

    def _enter(self, state: State, reason: str, facts: Facts) -> None:
        if state is self.state:
            return
        self.state, self.reason = state, reason
        self._since_ns = facts.time_ns
        self._healthy_since_ns = None


def _stale_state(facts: Facts) -> str:
    age = f"no new proprioception for {facts.state_age_s * 1e3:.0f} ms"
    return f"{age} ({facts.skipped})" if facts.skipped else age
