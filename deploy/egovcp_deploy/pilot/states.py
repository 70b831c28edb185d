"""The state machine of the runner: which state the robot is in, and why.

    INIT -> STAND -> ARMED -> RUN <-> HOLD          any -> DAMP, latched

DAMP lets a standing robot sink to the ground, so it is for what standing cannot survive: lost
proprioception, a controller that gives no numbers, a robot that is falling, the operator's
emergency stop. Without planner or camera the robot can still stand: that is HOLD.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from egovcp.bounds import bounded


class State(StrEnum):
    """What the robot is doing."""

    INIT = "init"
    """Waits for the first readings; motors damped."""
    STAND = "stand"
    """The gains come in and the controller takes the robot to its stance."""
    ARMED = "armed"
    """Stands in the neutral pose; the planner runs along, but is not obeyed."""
    RUN = "run"
    """The planner drives."""
    HOLD = "hold"
    """Stands; the hands ease to neutral, the velocity to zero."""
    DAMP = "damp"
    """Motors damped until the program is started again."""


class Request(StrEnum):
    """What the operator asks for."""

    STAND = "stand"
    ARM = "arm"
    RUN = "run"
    HOLD = "hold"
    ESTOP = "estop"


@dataclass(frozen=True)
class Limits:
    """When the robot is held or damped."""

    state_hold_s: float = bounded(0.1, above=0)
    """HOLD when proprioception is older, s."""
    state_damp_s: float = bounded(0.2, above=0)
    """DAMP when proprioception is older, s."""
    picture_hold_s: float = bounded(0.2, above=0)
    """HOLD when the picture is older than this, s."""
    planner_hold_s: float = bounded(0.14, above=0)
    """HOLD when the planner has not answered for so long, s."""
    misses_hold: int = bounded(5, least=0, most=10_000)
    """HOLD after more than so many ticks in a row without a plan in time."""
    tilt_damp: float = bounded(1.0, above=0, most=math.pi / 2)
    """DAMP beyond this angle between pelvis and vertical, rad."""
    height_damp: float = bounded(0.40, least=0)
    """DAMP below this height of the pelvis above the lower foot, m; the lowest stance has 0.5."""
    recover_s: float = bounded(1.0, least=0)
    """HOLD ends by itself when all has been well for so long, s."""
    stand_s: float = bounded(3.0, above=0)
    """Time in which the gains come in, s."""


@dataclass(frozen=True)
class Facts:
    """What the state machine judges by at one control tick."""

    time_ns: int
    """Now, monotonic."""
    state_age_s: float = 0.0
    """Since proprioception last brought something new."""
    picture_age_s: float = 0.0
    """Since the camera last brought something new."""
    planner_silence_s: float = 0.0
    """Since the planner last answered."""
    misses: int = 0
    """Ticks in a row without a plan in time."""
    tilt: float = 0.0
    """Angle between pelvis and vertical, rad."""
    height: float = 0.74
    """Pelvis above the lower foot, m."""
    controller_ok: bool = True
    """Whether the low-level controller's last targets were numbers."""
    planner_alive: bool = True
    """False once the planner is known to be gone."""
    refusal: str = ""
    """Why the robot must not be armed; empty: nothing speaks against it."""
    hold: str = ""
    """Why the robot must be held, found by a check outside the state machine; empty: nothing."""
    damp: str = ""
    """Why its motors must be damped, likewise."""
    skipped: str = ""
    """What was wrong with the proprioception since the newest that was used; empty: none came."""


def _stale(facts: Facts) -> str:
    """That proprioception is too old, and why."""
    words = f"no new proprioception for {facts.state_age_s * 1e3:.0f} ms"
    return f"{words} ({facts.skipped})" if facts.skipped else words


_NEXT: Final = {Request.STAND: State.INIT, Request.ARM: State.STAND, Request.RUN: State.ARMED}


class Supervisor:
    """Holds the state; `update` moves it on, at every control tick.

    Args:
        limits: when to hold and to damp.
        state: where to begin; a simulated robot that stands already begins ARMED.
    """

    def __init__(self, limits: Limits | None = None, state: State = State.INIT) -> None:
        self.limits = limits or Limits()
        self.state = state
        self.reason = "start"
        """Why the machine is in this state."""
        self._since_ns: int | None = None
        self._well_since_ns: int | None = None
        self._asked_to_hold = False

    def update(self, facts: Facts, request: Request | None = None) -> tuple[str, ...]:
        """Judge ``facts`` and the operator's ``request``; what changed, for the log."""
        if self._since_ns is None:
            self._since_ns = facts.time_ns
        before, self._events = self.state, list[str]()
        if self.state is not State.DAMP:
            self._judge(facts, request)
        if self.state is not before:
            self._events.append(f"{before} -> {self.state}: {self.reason}")
        return tuple(self._events)

    def time_in_state_s(self, now_ns: int) -> float:
        """Since the state was entered, s."""
        return 0.0 if self._since_ns is None else (now_ns - self._since_ns) / 1e9

    def _judge(self, facts: Facts, request: Request | None) -> None:
        if request is Request.ESTOP:
            return self._enter(State.DAMP, "emergency stop", facts)
        if self.state is not State.INIT and (why := self._why_damp(facts)):
            return self._enter(State.DAMP, why, facts)
        if self.state in (State.RUN, State.HOLD):
            return self._run_or_hold(facts, request)
        if request is not None:
            self._advance(facts, request)
        return None

    def _why_damp(self, facts: Facts) -> str:
        limits = self.limits
        if facts.damp:
            return facts.damp
        if facts.state_age_s > limits.state_damp_s:
            return _stale(facts)
        if not facts.controller_ok:
            return "the low-level controller gave targets that are not numbers"
        if not facts.tilt <= limits.tilt_damp:
            return f"the pelvis is tilted by {facts.tilt:.2f} rad"
        if self.state is not State.STAND and not facts.height >= limits.height_damp:
            return f"the pelvis is {facts.height:.2f} m above the foot"
        return ""

    def _why_hold(self, facts: Facts) -> str:
        limits = self.limits
        if facts.hold:
            return facts.hold
        if not facts.planner_alive:
            return "the planner is gone"
        if facts.planner_silence_s > limits.planner_hold_s:
            return f"the planner has not answered for {facts.planner_silence_s * 1e3:.0f} ms"
        if facts.misses > limits.misses_hold:
            return f"{facts.misses} ticks in a row without a plan in time"
        if facts.state_age_s > limits.state_hold_s:
            return _stale(facts)
        if facts.picture_age_s > limits.picture_hold_s:
            return f"no new picture for {facts.picture_age_s * 1e3:.0f} ms"
        return ""

    def _run_or_hold(self, facts: Facts, request: Request | None) -> None:
        if request is Request.HOLD:
            self._asked_to_hold = True
            self._well_since_ns = None
            self._enter(State.HOLD, "the operator asked for it", facts)
            return
        if request is Request.RUN:
            self._asked_to_hold = False
        why = self._why_hold(facts)
        if why:
            self._well_since_ns = None
            self._enter(State.HOLD, why, facts)
        elif self.state is State.HOLD and not self._asked_to_hold:
            self._recover(facts)

    def _recover(self, facts: Facts) -> None:
        """Back to RUN once all has been well for a while: no flicker between the two.

        A single late plan is bridged by the one before and counts as well.
        """
        if facts.misses > 1:
            self._well_since_ns = None
            return
        if self._well_since_ns is None:
            self._well_since_ns = facts.time_ns
        if facts.time_ns - self._well_since_ns >= self.limits.recover_s * 1e9:
            self._enter(State.RUN, f"all well for {self.limits.recover_s:g} s", facts)

    def _advance(self, facts: Facts, request: Request) -> None:
        """One step of INIT -> STAND -> ARMED -> RUN, if it is the next and nothing objects."""
        if _NEXT.get(request) is not self.state:
            if request is not Request.HOLD:
                self._events.append(f"{request} refused: the robot is in {self.state}")
            return
        objection = self._objection(facts, request)
        if objection:
            self._events.append(f"{request} refused: {objection}")
            return
        target = {Request.STAND: State.STAND, Request.ARM: State.ARMED, Request.RUN: State.RUN}
        self._asked_to_hold = False
        self._enter(target[request], "the operator asked for it", facts)

    def _objection(self, facts: Facts, request: Request) -> str:
        if facts.state_age_s > self.limits.state_hold_s:
            return "proprioception is not fresh"
        if facts.refusal:
            return facts.refusal
        if request is Request.ARM:
            left = self.limits.stand_s - self.time_in_state_s(facts.time_ns)
            if left > 0:
                return f"still standing up, {left:.1f} s to go"
            if facts.height < self.limits.height_damp:
                return f"the pelvis is only {facts.height:.2f} m above the foot"
        return self._why_hold(facts) if request is Request.RUN else ""

    def _enter(self, state: State, reason: str, facts: Facts) -> None:
        if state is self.state:
            return
        self.state, self.reason = state, reason
        self._since_ns = facts.time_ns
        self._well_since_ns = None
