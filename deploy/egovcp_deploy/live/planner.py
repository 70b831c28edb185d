"""The planner's side of a run on the wall clock: think, log, and pass on the operator's orders.

Whatever fails here, the robot goes on standing: `PlannerLoop` then only listens to the operator.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from egovcp.errors import EgovcpError
from egovcp.log.async_sink import warn_on_stderr
from egovcp.log.sink import Sink
from egovcp.log.tick import Tick
from egovcp.rate import Clock
from egovcp.spec import PLANNER_DT
from egovcp_deploy.live.interrupts import Interrupts
from egovcp_deploy.live.link import Link, Order, decode_report, encode_order, encode_reply
from egovcp_deploy.live.operators import EASE_S, Operator
from egovcp_deploy.pilot.desk import SKIPPED, Reply, Report, Thinker
from egovcp_deploy.pilot.effort import BUDGET_S
from egovcp_deploy.pilot.states import Request, State
from egovcp_deploy.runner import thoughts

_WAIT_S: Final = 0.01
_AFTERMATH_S: Final = 1.0  # what is still recorded once the motors are damped
_START_S: Final = 60.0  # for the control process to come up
_HOPE: Final = 0.98  # decoding that took too long once may be faster the next time
_NS: Final = 1e9


@dataclass
class LiveSummary:
    """What came of a run."""

    ticks: int = 0
    planned: int = 0
    """Ticks whose plan came from their own observation."""
    skipped: int = 0
    """Observations that the policy did not use, because their state was not finite."""
    late: int = 0
    """Plans that came after their tick."""
    running: int = 0
    """Ticks in RUN."""
    held: int = 0
    """Ticks in HOLD."""
    damped: str = ""
    """Why the motors were damped before the run was over; empty: they were not."""
    plan_ms: list[float] = field(default_factory=list)
    latency_ms: list[float] = field(default_factory=list)
    """From the observation to the plan on its way back, per plan."""
    iterations: list[int] = field(default_factory=list)
    events: list[str] = field(default_factory=list)
    missing_ticks: dict[str, int] = field(default_factory=dict)
    """Log -> ticks that it lacks, because its disk was full or too slow."""
    failure: Exception | None = None
    """What ended the planning, after which the robot was held."""


class PlannerLoop:
    """One run.

    Args:
        thinker: the planner.
        link: to the control process.
        operator: who says what to do.
        sink: the log; it must not block.
        clock: the monotonic one that reports are stamped with.
        control_alive: whether the control process is there.
        stays: whether a robot that holds after Ctrl-C goes on standing until the second one, as a
            real one must that nobody has hung up yet.
        stands: whether a robot whose planner has failed stands until the operator ends it; else
            it is held for as long as its hands need, and the run ends.
        tell: takes what the operator must know at once, one line.
    """

    def __init__(
        self,
        thinker: Thinker,
        link: Link,
        operator: Operator,
        sink: Sink,
        clock: Clock,
        control_alive: Callable[[], bool],
        stays: bool = False,
        stands: bool = True,
        tell: Callable[[str], None] = warn_on_stderr,
    ) -> None:
        self._thinker, self._link, self._operator = thinker, link, operator
        self._sink, self._clock, self._control_alive = sink, clock, control_alive
        self._stays, self._stands, self._tell = stays, stands, tell
        self.summary = LiveSummary()
        self.interrupts = Interrupts()
        self.quitting = False
        """Whether the control process has been told to end."""
        self._mode = ""
        self._told: list[str] = []  # events of this side, for the next tick
        self._ending = ""  # why the run ended
        self._begin_ns: int | None = None
        self._decoding_ns = 0
        self._pending: tuple[Report, Reply | None] | None = None
        self._held_ns: int | None = None
        self._damped_ns: int | None = None

    def run(self, on_tick: Callable[[Tick], None] = lambda tick: None) -> LiveSummary:
        """Until the operator ends it, the motors are damped, or the control process is gone.

        An exception ends the planning but not the run: see `LiveSummary.failure`.
        """
        with self.interrupts.caught():
            try:
                self._plan(on_tick)
            except Exception as error:  # noqa: BLE001 - whatever it is, the robot must not fall
                self._fail(error)
                self._stand_by(on_tick)
        with suppress(Exception):  # a log that fails must not hide what the run was ended by
            self._finish(on_tick)
        return self.summary

    def _plan(self, on_tick: Callable[[Tick], None]) -> None:
        started_ns = self._clock.now_ns()
        while not self.quitting and self._control_alive():
            now = self._clock.now_ns()
            if self._begin_ns is None and now - started_ns > _START_S * _NS:
                break
            self._obey(now)
            reports = self._receive()
            if reports:
                self._think(reports, on_tick)

    def _receive(self) -> list[Report]:
        found = (decode_report(parts) for parts in self._link.receive(_WAIT_S))
        return [report for report in found if report is not None]

    def _think(self, reports: Sequence[Report], on_tick: Callable[[Tick], None]) -> None:
        last, reply = reports[-1], None
        self._begin_ns = reports[0].time_ns if self._begin_ns is None else self._begin_ns
        self._mode = last.mode
        try:
            reply = self._answer(reports)
        finally:  # what could not be thought about is recorded, too
            for report in reports:
                self._log(report, reply if report is last else None, on_tick)

    def _answer(self, reports: Sequence[Report]) -> Reply:
        last = reports[-1]
        due_ns = last.time_ns + round(BUDGET_S * _NS)
        reply = self._thinker.think(reports, lambda: (due_ns - self._clock.now_ns()) / _NS)
        self._link.send(encode_reply(reply))
        self._measure(last, reply)
        return self._decoded(last, reply)

    def _decoded(self, report: Report, reply: Reply) -> Reply:
        """With pictures for the log, if these do not make the next observation wait."""
        begin = self._clock.now_ns()
        if begin + self._decoding_ns > report.time_ns + PLANNER_DT * _NS:
            self._decoding_ns = round(self._decoding_ns * _HOPE)
            return reply
        reply = self._thinker.decode(reply)
        self._decoding_ns = self._clock.now_ns() - begin
        return reply

    def _measure(self, report: Report, reply: Reply) -> None:
        latency = (self._clock.now_ns() - report.time_ns) / _NS
        late = latency > PLANNER_DT
        self.summary.planned += 1
        self.summary.late += late
        self.summary.skipped += reply.events.count(SKIPPED)
        before = self._thinker.samples
        if self._thinker.pace(reply, late):
            after = self._thinker.samples
            why = "time to spare" if after > before else "too little time"
            self._told.append(f"{why}: {after} candidates from now on")
        self.summary.plan_ms.append(reply.plan_ms)
        self.summary.latency_ms.append(latency * 1e3)
        self.summary.iterations.append(reply.step.iterations)

    # --- the log -------------------------------------------------------------------------
    def _log(self, report: Report, reply: Reply | None, on_tick: Callable[[Tick], None]) -> None:
        """A tick is complete when the next report tells what was sent in it."""
        self._count(report)
        before, self._pending = self._pending, (report, reply)
        if before is not None and before[0].tick == report.tick - 1:
            tick = self._tick(*before, report)
            self._sink.write(tick)
            on_tick(tick)

    def _count(self, report: Report) -> None:
        self.summary.ticks += 1
        self.summary.running += report.mode == State.RUN
        self.summary.held += report.mode == State.HOLD
        self.summary.events += report.events
        if report.mode == State.DAMP and self._damped_ns is None:
            self._damped_ns = report.time_ns
            self.summary.damped = _reason(report.events)

    def _finish(self, on_tick: Callable[[Tick], None]) -> None:
        """Record the last tick, which no report follows, with why the run ended. Its action is
        not known; that of the tick before stands for it."""
        if self._pending is None:
            return
        (report, reply), self._pending = self._pending, None
        self._told.append(f"end of the run: {self._ending or 'the control process is gone'}")
        tick = self._tick(report, reply, report)
        self._sink.write(tick)
        on_tick(tick)

    def _tick(self, report: Report, reply: Reply | None, following: Report) -> Tick:
        assert self._begin_ns is not None
        events = (*report.events, *(reply.events if reply else ()), *self._told)
        self._told.clear()
        return Tick(
            index=report.tick,
            time_ns=report.time_ns - self._begin_ns,
            depth=report.depth,
            state=report.state,
            action_planned=following.sent if reply is None else reply.step.action[0],
            action_sent=following.sent,
            timing_ms={} if reply is None else {"plan": reply.plan_ms},
            events=events,
            mode=report.mode,
            motors=report.motors,
            link=report.link,
            **thoughts(reply),
        )

    # --- a failure ------------------------------------------------------------------------
    def _fail(self, error: Exception) -> None:
        """Plan no more: the robot is held, and whoever is beside it hears why."""
        self.summary.failure = error
        self._link.send(encode_order(Order(Request.HOLD)))
        what = f"the planner failed: {failure_words(error)}"
        self._told.append(what)
        if not self._stands:
            self._held_ns = self._clock.now_ns()
        how = "the robot is held until somebody ends it: Ctrl-C twice damps it"
        with suppress(Exception):  # the terminal may be what failed
            self._tell(f"{what}; {how if self._stands else 'the run ends'}")

    def _stand_by(self, on_tick: Callable[[Tick], None]) -> None:
        """What is left without a planner: the operator, and the log while it can be written."""
        while not self.quitting and self._control_alive():
            for report in self._receive():
                self._begin_ns = report.time_ns if self._begin_ns is None else self._begin_ns
                self._mode = report.mode
                with suppress(Exception):
                    self._log(report, None, on_tick)
            self._obey(self._clock.now_ns())
            if self._mode in ("", State.INIT):
                self._quit("the planner failed before the robot stood")

    # --- the end -------------------------------------------------------------------------
    def _obey(self, now_ns: int) -> None:
        interrupted = self._interrupted(now_ns)
        for order in self._ordered(now_ns):
            self._order(order, "by the operator")
        for order in interrupted:
            self._order(order, "interrupted" if self.interrupts.count else "the planner failed")
        if self._damped_ns is not None and now_ns - self._damped_ns > _AFTERMATH_S * _NS:
            self._quit("the motors are damped")

    def _order(self, order: Order, ending: str) -> None:
        """Pass on an order; ``ending`` is why the run ends if it is the last."""
        self._link.send(encode_order(order))
        if order.quit:
            self.quitting, self._ending = True, ending

    def _ordered(self, now_ns: int) -> Sequence[Order]:
        """What the operator wants; a second failure, of the operator, is nobody's business."""
        try:
            return self._operator.orders(now_ns, self._mode)
        except Exception:
            if self.summary.failure is None:
                raise
            return ()

    def _interrupted(self, now_ns: int) -> list[Order]:
        """Ctrl-C once: hold, let the hands come to rest, end if that is safe. Twice: damp."""
        if self.interrupts.count >= 2:
            return [Order(Request.ESTOP)] if self._damped_ns is None else []
        if self.interrupts.count == 1 and self._held_ns is None:
            self._held_ns = now_ns
            return [Order(Request.HOLD)]
        if self._held_ns is None or now_ns - self._held_ns <= EASE_S * _NS:
            return []
        return [Order(Request.HOLD, quit=not self._stays)]

    def _quit(self, why: str) -> None:
        self._order(Order(quit=True), why)


def _reason(events: Sequence[str]) -> str:
    """Why, from the line that tells of the change to DAMP."""
    told = [event.partition(": ")[2] for event in events if f"-> {State.DAMP}" in event]
    return told[-1] if told else "unknown"


def failure_words(error: Exception) -> str:
    """One line about an exception."""
    words = " ".join(str(error).split())
    return words if isinstance(error, EgovcpError) else f"{type(error).__name__}: {words}"
