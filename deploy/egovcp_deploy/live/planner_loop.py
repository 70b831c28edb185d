"""The planner's loop of a run on the wall clock: plan, log, and pass on operator commands.

Any exception ends the planning but not the run: the robot is held, and `PlannerLoop` continues to
log and to pass on the operator's commands.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final

from egovcp.errors import EgovcpError
from egovcp.log.async_sink import warn_on_stderr
from egovcp.log.tick import Sink, Tick
from egovcp.rate import Clock
from egovcp.spec import PLANNER_DT
from egovcp.workers import stop_on_signal
from egovcp_deploy.live.link import (
    MAX_RECEIVED,
    Link,
    decode_observation,
    encode_operator_command,
    encode_plan,
)
from egovcp_deploy.live.operators import EASE_S, Operator
from egovcp_deploy.pilot.planner import (
    BUDGET_S,
    SKIPPED,
    ObservationMessage,
    PlanMessage,
    PlannerRunner,
    planner_fields,
)
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest, State

_WAIT_S: Final = 0.01
_AFTER_DAMP_S: Final = 1.0  # still recorded once the motors are damped
_ESTOP_S: Final = 0.5  # for the control process to report DAMP; else it hangs
START_S: Final = 60.0  # for the control process to send its first observation
_DECODING_DECAY: Final = 0.98  # of the expected decoding time, per image that is not decoded
_NS: Final = 1e9
_TOWARDS_RUN: Final = (OperatorRequest.STAND, OperatorRequest.ARM, OperatorRequest.RUN)


@dataclass
class LiveSummary:
    """Result of a run."""

    ticks: int = 0
    planned: int = 0  # ticks whose plan was made from their own observation
    skipped: int = 0  # observations that the policy ignored, see `SKIPPED`
    late: int = 0  # plans that came after their tick
    running: int = 0  # ticks in RUN
    held: int = 0  # ticks in HOLD
    damped: str = ""  # why the motors were damped before the run was over; empty: they were not
    plan_ms: list[float] = field(default_factory=list)
    latency_ms: list[float] = field(default_factory=list)  # from an observation to its plan
    iterations: list[int] = field(default_factory=list)
    events: list[str] = field(default_factory=list)
    failure: Exception | None = None  # what ended the planning, after which the robot was held


class PlannerLoop:
    """One run.

    Args:
        sink: the log; it must not block.
        clock: monotonic, the one that stamps the observations.
        control_alive: whether the control process runs.
        stays: after the first Ctrl-C the robot stands until the second one. Else the run ends
            after `EASE_S`, and the motors are damped.
        kill: kills a control process that does not damp the motors after the second Ctrl-C; its
            watchdog must damp them.
        warn: prints a line; must not block.
    """

    def __init__(
        self,
        runner: PlannerRunner,
        link: Link,
        operator: Operator,
        sink: Sink,
        clock: Clock,
        control_alive: Callable[[], bool],
        stays: bool = False,
        kill: Callable[[], None] = lambda: None,
        warn: Callable[[str], None] = warn_on_stderr,
    ) -> None:
        self._runner, self._link, self._operator = runner, link, operator
        self._sink, self._clock, self._control_alive = sink, clock, control_alive
        self._stays, self._kill, self._warn = stays, kill, warn
        self.summary = LiveSummary()
        self.interrupts: list[int] = []  # SIGINT as often as received
        self.quitting = False  # whether the control process is expected to end
        self._mode = ""
        self._events: list[str] = []  # of this process, for the next tick
        self._end_reason = ""
        self._begin_ns: int | None = None
        self._decoding_ns = 0
        self._pending: tuple[ObservationMessage, PlanMessage | None] | None = None
        self._held_ns: int | None = None
        self._estop_ns: int | None = None
        self._damped_ns: int | None = None

    def run(self, on_tick: Callable[[Tick], None] = lambda tick: None) -> LiveSummary:
        """Run until the operator ends it, the motors are damped, or the control process ends. An
        exception ends the planning but not the run, see `LiveSummary.failure`."""
        started_ns, self._on_tick = self._clock.now_ns(), on_tick
        with stop_on_signal(signals=(signal.SIGINT,), interrupt=False) as self.interrupts:
            while not self.quitting and self._control_alive():
                if self._begin_ns is None and self._clock.now_ns() - started_ns > START_S * _NS:
                    break
                try:
                    self._step()
                except Exception as error:  # noqa: BLE001 - the robot must not fall, whatever it is
                    self._fail(error)
        with suppress(Exception):  # an error of the log must not hide why the run ended
            self._log_last_tick()
        return self.summary

    def _step(self) -> None:
        """Pass on the operator's commands, plan from new observations, and log them."""
        self._handle_commands(self._clock.now_ns())
        observations = self._receive()
        self._check_estop(self._clock.now_ns())
        plan: PlanMessage | None = None
        try:
            if observations and self.summary.failure is None:
                plan = self._plan(observations)
        finally:  # observations are logged even if the planner fails
            for observation in observations:
                self._log(observation, plan if observation is observations[-1] else None)

    def _receive(self) -> list[ObservationMessage]:
        received = batch = list(self._link.receive(_WAIT_S))
        while len(batch) >= MAX_RECEIVED:  # until no message waits
            batch = list(self._link.receive())
            received = [*received, *batch]
        decoded = (decode_observation(parts) for parts in received)
        observations = [observation for observation in decoded if observation is not None]
        summary = self.summary
        for observation in observations:
            self._mode = observation.mode
            if self._begin_ns is None:
                self._begin_ns = observation.time_ns
            summary.ticks += 1
            summary.running += self._mode == State.RUN
            summary.held += self._mode == State.HOLD
            summary.events += observation.events
            if self._mode == State.DAMP and self._damped_ns is None:
                self._damped_ns = observation.time_ns
                summary.damped = _damp_reason(observation.events)
        return observations

    def _plan(self, observations: Sequence[ObservationMessage]) -> PlanMessage:
        last = observations[-1]
        due_ns = last.time_ns + round(BUDGET_S * _NS)
        plan = self._runner.plan(observations, lambda: (due_ns - self._clock.now_ns()) / _NS)
        self._link.send(encode_plan(plan))
        self._measure(last, plan)
        begin = self._clock.now_ns()
        if begin + self._decoding_ns > last.time_ns + PLANNER_DT * _NS:
            # Decoding would delay the next observation. It may be faster the next time.
            self._decoding_ns = round(self._decoding_ns * _DECODING_DECAY)
            return plan
        plan = self._runner.decode(plan)
        self._decoding_ns = self._clock.now_ns() - begin
        return plan

    def _measure(self, observation: ObservationMessage, plan: PlanMessage) -> None:
        latency = (self._clock.now_ns() - observation.time_ns) / _NS
        late = latency > PLANNER_DT
        summary = self.summary
        summary.planned += 1
        summary.late += late
        summary.skipped += plan.events.count(SKIPPED)
        summary.plan_ms.append(plan.plan_ms)
        summary.latency_ms.append(latency * 1e3)
        summary.iterations.append(plan.step.iterations)
        summary.events += plan.events
        self._events += self._runner.adapt(plan, late)

    # --- the log -------------------------------------------------------------------------
    def _log(self, observation: ObservationMessage, plan: PlanMessage | None) -> None:
        """Log the previous tick: the action that was sent in it arrives with the next observation.
        If that was lost, the tick is not logged, because its action is unknown."""
        before, self._pending = self._pending, (observation, plan)
        if before is not None and before[0].tick == observation.tick - 1:
            self._write(*before, observation)

    def _log_last_tick(self) -> None:
        """Log the last tick with why the run ended. No observation follows it, so its action is
        unknown; the action before it is logged instead."""
        if self._pending is not None:
            (observation, plan), self._pending = self._pending, None
            reason = self._end_reason or "the control process is gone"
            self._events.append(f"end of the run: {reason}")
            self._write(observation, plan, observation)

    def _write(
        self,
        observation: ObservationMessage,
        plan: PlanMessage | None,
        following: ObservationMessage,
    ) -> None:
        assert self._begin_ns is not None
        events = (*observation.events, *(plan.events if plan else ()), *self._events)
        self._events.clear()
        tick = Tick(
            index=observation.tick,
            time_ns=observation.time_ns - self._begin_ns,
            depth=observation.depth,
            state=observation.state,
            action_planned=following.sent if plan is None else plan.step.action[0],
            action_sent=following.sent,
            timing_ms={} if plan is None else {"plan": plan.plan_ms},
            events=events,
            mode=observation.mode,
            motors=observation.motors,
            link=observation.link,
            **planner_fields(plan),
        )
        self._sink.write(tick)
        self._on_tick(tick)

    # --- a failure ------------------------------------------------------------------------
    def _fail(self, error: Exception) -> None:
        """Hold the robot and warn the operator, at the first failure of a run."""
        if self.summary.failure is None:
            self.summary.failure = error
            self._send(OperatorCommand(OperatorRequest.HOLD))
            message = f"the planner failed: {describe_failure(error)}"
            self._events.append(message)
            if self._mode not in ("", State.INIT):
                end = "the operator ends the run" if self._stays else "--operator.duration is over"
                message += f"; the robot is held until {end}: Ctrl-C twice damps it"
            with suppress(Exception):  # the terminal may be what failed
                self._warn(message)

    # --- operator commands ---------------------------------------------------------------
    def _handle_commands(self, now_ns: int) -> None:
        commands: Sequence[OperatorCommand] = ()
        try:
            failed = self.summary.failure is not None
            commands = self._operator.commands(now_ns, self._mode, failed)
        except Exception:
            if self.summary.failure is None:
                raise  # else the operator's failure is not the first one, which is reported
        for command in commands:
            if not (self.interrupts and command.request in _TOWARDS_RUN):
                self._send(command, "by the operator")
        for command in self._interrupt_commands(len(self.interrupts), now_ns):
            self._send(command, "interrupted")
        if self._damped_ns is not None and now_ns - self._damped_ns > _AFTER_DAMP_S * _NS:
            self._send(OperatorCommand(quit=True), "the motors are damped")
        if self.summary.failure is not None and self._mode in ("", State.INIT):
            self._send(OperatorCommand(quit=True), "the planner failed before the robot stood")

    def _interrupt_commands(self, interrupts: int, now_ns: int) -> list[OperatorCommand]:
        """First Ctrl-C: hold, ease the hands, and end the run unless ``stays``; before the robot
        stands, end it at once. Second: damp."""
        if not interrupts:
            return []
        if self._mode in ("", State.INIT):
            return [OperatorCommand(quit=True)]
        if interrupts >= 2:
            self._estop_ns = now_ns if self._estop_ns is None else self._estop_ns
            estop = OperatorCommand(OperatorRequest.ESTOP)
            return [estop] if self._damped_ns is None else []
        if self._held_ns is None:
            self._held_ns = now_ns
        eased = now_ns - self._held_ns > EASE_S * _NS
        return [OperatorCommand(OperatorRequest.HOLD, quit=eased and not self._stays)]

    def _check_estop(self, now_ns: int) -> None:
        """Kill the control process if it has not followed the emergency stop of Ctrl-C."""
        if self._estop_ns is None or self._damped_ns is not None:
            return
        if now_ns - self._estop_ns > _ESTOP_S * _NS:
            self._kill()

    def _send(self, command: OperatorCommand, end_reason: str = "") -> None:
        """Pass on a command; ``end_reason`` is why the run ends if it is the last."""
        self._link.send(encode_operator_command(command))
        if command.quit:
            self.quitting, self._end_reason = True, end_reason


def _damp_reason(events: Sequence[str]) -> str:
    """The reason in the log line of the change to DAMP."""
    reasons = [event.partition(": ")[2] for event in events if f"-> {State.DAMP}" in event]
    return reasons[-1] if reasons else "unknown"


def describe_failure(error: Exception) -> str:
    """An exception as one line."""
    message = " ".join(str(error).split())
    return message if isinstance(error, EgovcpError) else f"{type(error).__name__}: {message}"
