"""Decides, tick by tick, what a robot is sent: the planner's action, or what is safe instead.

A planner tick t of 40 ms goes

    sense(readings) -> judge(operator) -> report(o_t) ... collect(replies) ... decide(a_t)

On a robot, replies arrive while the tick lasts and `sense` and `judge` run at 50 Hz; in lock-step
simulation all of it happens at once. Nothing here blocks, sleeps or does I/O of its own.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings
from egovcp.spec import COMMAND_SLICE
from egovcp_deploy.pilot.desk import Desk, Reply, Report
from egovcp_deploy.pilot.freshness import Freshness
from egovcp_deploy.pilot.plans import PlanBook
from egovcp_deploy.pilot.posture import Posture, posture
from egovcp_deploy.pilot.states import Facts, Limits, Request, State, Supervisor
from egovcp_deploy.safety import SafetyFilter

Array = NDArray[np.float64]

REJECTED: Final = "plan rejected: not finite"
UNASKED: Final = "plan rejected: for a tick that was not reported"
_UPRIGHT: Final = Posture(0.0, 0.74)


class Pilot:
    """Between one robot and its planner.

    Args:
        desk: where the planner is.
        limits: of the state machine.
        state: where the machine begins; ARMED for a simulated robot that stands already.
    """

    def __init__(self, desk: Desk, limits: Limits | None = None, state: State = State.INIT) -> None:
        self._desk = desk
        self._limits = limits or Limits()
        self._begin_in = state
        self.restart()

    def restart(self) -> None:
        """A new run: tick 0 comes next, nothing has been sent, and the machine starts again."""
        self.supervisor = Supervisor(self._limits, self._begin_in)
        self.tick = 0
        """The planner tick that is reported next, or that is being decided."""
        self.sent: Array = np.zeros(7)
        """a_{t-1}, (7,)."""
        self._safety = SafetyFilter()
        self._book = PlanBook()
        self._proprioception, self._eye = Freshness(), Freshness()
        self._posture = _UPRIGHT
        self._unanswered: deque[Report] = deque(maxlen=64)
        self._first = True  # the next report starts the recurrence
        self._began = 0  # tick of that report; plans from before it are of another life
        self._events: list[str] = []

    # --- at every control tick -----------------------------------------------------------
    def sense(
        self,
        now_ns: int,
        state: NDArray[np.floating] | None,
        depth: NDArray[np.uint16] | None,
        state_ns: int | None = None,
        depth_ns: int | None = None,
    ) -> None:
        """Take the newest readings.

        Args:
            now_ns: now.
            state: (74,) proprioception; None: there is none.
            depth: (48, 64); None: there is none.
            state_ns: when the state arrived, on the clock of ``now_ns``; None: now.
            depth_ns: likewise.
        """
        measured = None if state is None else np.delete(np.asarray(state), COMMAND_SLICE)
        self._proprioception.update(now_ns if state_ns is None else state_ns, measured)
        self._eye.update(now_ns if depth_ns is None else depth_ns, depth)
        if measured is not None and np.isfinite(measured).all():
            self._posture = posture(np.asarray(state))

    def judge(
        self,
        now_ns: int,
        request: Request | None = None,
        controller_ok: bool = True,
        refusal: str = "",
        hold: str = "",
        damp: str = "",
        skipped: str = "",
    ) -> State:
        """Move the state machine on; where it is now. Reasons: see `Facts`."""
        before = self.supervisor.state
        facts = replace(
            self._facts(now_ns, controller_ok),
            refusal=refusal,
            hold=hold,
            damp=damp,
            skipped=skipped,
        )
        self._events += self.supervisor.update(facts, request)
        if before is State.ARMED and self.supervisor.state is State.RUN:
            self._first = True
            self._book.reset()
        return self.supervisor.state

    def note(self, events: Iterable[str]) -> None:
        """Add lines to the events."""
        self._events += events

    def _facts(self, now_ns: int, controller_ok: bool) -> Facts:
        silence = (now_ns - self._unanswered[0].time_ns) / 1e9 if self._unanswered else 0.0
        return Facts(
            time_ns=now_ns,
            state_age_s=self._proprioception.age_s(now_ns),
            picture_age_s=self._eye.age_s(now_ns),
            planner_silence_s=silence,
            misses=self._book.misses,
            tilt=self._posture.tilt,
            height=self._posture.height,
            controller_ok=controller_ok,
            planner_alive=self._desk.alive,
        )

    # --- at every planner tick -----------------------------------------------------------
    def report(
        self,
        now_ns: int,
        depth: NDArray[np.uint16],
        state: NDArray[np.float32],
        events: tuple[str, ...] = (),
        motors: MotorReadings | None = None,
        link: Mapping[str, float] | None = None,
    ) -> None:
        """Hand o_t to the planner, and with it ``events``, ``motors`` and ``link`` for its log."""
        mode = self.supervisor.state
        sent = self.sent.copy()
        if self._first:
            self._began = self.tick
        report = Report(
            self.tick, now_ns, depth, state, sent, self._first, mode, events, motors, link or {}
        )
        self._first = False
        self._unanswered.append(report)
        self._desk.submit(report)

    def collect(self, now_ns: int) -> Reply | None:
        """Fetch what the planner has answered by ``now_ns``; the reply of this tick, if it came."""
        fresh = None
        for reply in self._desk.poll(now_ns):
            if reply.tick > self.tick:  # of no report; it would outlast all that are
                self._events.append(UNASKED)
                continue
            while self._unanswered and self._unanswered[0].tick <= reply.tick:
                self._unanswered.popleft()
            self._events += reply.events
            if self._first or reply.tick < self._began:
                continue
            if not self._book.offer(reply.tick, _plan(reply)):
                self._events.append(REJECTED)
            if reply.tick == self.tick:
                fresh = reply
        return fresh

    @property
    def misses(self) -> int:
        """Ticks in a row without a plan in time."""
        return self._book.misses

    @property
    def answered(self) -> bool:
        """Whether a usable plan for this tick is there."""
        return self._book.has(self.tick)

    def decide(self) -> Array:
        """a_t (7,), once per tick; the next tick begins."""
        wanted = self._book.decide(self.tick)
        if self.supervisor.state is not State.RUN or self._first:
            self.sent = self._safety.ease()[0]
        elif wanted is None:
            self.sent = self._safety.repeat()[0]
        else:
            self.sent = self._safety.filter(wanted[None]).action[0]
        self.tick += 1
        return self.sent.copy()

    def events(self) -> tuple[str, ...]:
        """What has happened since the last call."""
        events, self._events = tuple(self._events), []
        return events


def _plan(reply: Reply) -> Array:
    """(N, 7); a policy that does not plan ahead knows one action."""
    step = reply.step
    return np.asarray(step.plan[0] if step.plan.size else step.action, np.float64)
