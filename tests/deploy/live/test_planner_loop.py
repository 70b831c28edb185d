"""The planner's loop without processes: commands after a failure."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest

from egovcp.errors import EnvironmentFailure
from egovcp.log.tick import Tick
from egovcp.plan import PolicyStep
from egovcp.spec import ACTION_DIM, STATE_DIM
from egovcp_deploy.live.link import MAX_RECEIVED, decode_operator_command, encode_observation
from egovcp_deploy.live.planner_loop import PlannerLoop
from egovcp_deploy.pilot.planner import ObservationMessage, PlannerRunner
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest, State
from tests.support.lockstep import LockstepClock
from tests.support.sinks import MemorySink

TICK_NS = 40_000_000


class Still:
    """A policy that stays neutral and fails in one tick."""

    def __init__(self, fails_at: int) -> None:
        self._left = fails_at

    def reset(self) -> None: ...

    def act(self, depth: object, state: object, remaining: object = None) -> PolicyStep:
        self._left -= 1
        if self._left < 0:
            raise RuntimeError("out of\nideas")
        plan = np.zeros((1, 4, ACTION_DIM), np.float32)
        return PolicyStep(plan[:, 0], plan, iterations=1)

    def observe(self, depth: object, state: object) -> None: ...

    def advance(self, sent: object) -> None: ...


class ControlStub:
    """The control process at the other end of the link: a report every tick, RUN until HOLD. It
    receives nothing if it is ``deaf``."""

    deaf = False

    def __init__(self, clock: LockstepClock, mode: State, ticks: int) -> None:
        self._clock, self.mode, self._ticks = clock, mode, ticks
        self._tick = 0
        self.commands: list[OperatorCommand] = []

    def alive(self) -> bool:
        return self._tick < self._ticks

    def send(self, parts: Sequence[bytes]) -> bool:
        command = decode_operator_command(parts) if len(parts) == 1 else None
        if command is not None and not self.deaf:
            self.commands.append(command)
            if command.request is OperatorRequest.HOLD and self.mode is State.RUN:
                self.mode = State.HOLD
            if command.request is OperatorRequest.ESTOP:
                self.mode = State.DAMP
        return True

    def receive(self, timeout_s: float = 0.0) -> Iterator[list[bytes]]:
        self._clock.advance(TICK_NS)
        depth, state = np.zeros((48, 64), np.uint16), np.zeros(STATE_DIM, np.float32)
        sent = np.zeros(ACTION_DIM)
        now = self._clock.now_ns()
        yield encode_observation(
            ObservationMessage(self._tick, now, depth, state, sent, self._tick == 0, self.mode)
        )
        self._tick += 1

    def kill(self) -> None:
        self._ticks = 0

    @property
    def requests(self) -> list[OperatorRequest]:
        return [command.request for command in self.commands if command.request is not None]


class ScriptedOperator:
    """An operator whose answers are decided by the test."""

    def __init__(self, answer: Callable[[str], list[OperatorCommand]] = lambda mode: []) -> None:
        self._answer = answer

    def commands(self, now_ns: int, mode: str, failed: bool = False) -> list[OperatorCommand]:
        return self._answer(mode)


class Broken(MemorySink):
    """A log that fails at its third tick and from then on."""

    def write(self, tick: Tick) -> None:
        super().write(tick)
        if len(self.ticks) > 2:
            raise EnvironmentFailure("no paper")


@pytest.fixture
def make_loop() -> Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]]:
    """A loop whose planner fails in tick 5, with a control process of 200 ticks."""

    def make(
        fails_at: int = 5,
        operator: ScriptedOperator | None = None,
        sink: MemorySink | None = None,
        mode: State = State.RUN,
    ) -> tuple[ControlStub, PlannerLoop, MemorySink]:
        clock = LockstepClock(time_ns=10**12)
        control, log = ControlStub(clock, mode, 200), sink or MemorySink()
        loop = PlannerLoop(
            PlannerRunner(Still(fails_at)),
            control,  # type: ignore[arg-type]
            operator or ScriptedOperator(),
            log,
            clock,
            control.alive,
            kill=control.kill,
        )
        return control, loop, log

    return make


def test_a_planner_that_raises_holds_the_robot_and_the_log_continues(
    make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    control, loop, log = make_loop()
    summary = loop.run()
    assert isinstance(summary.failure, RuntimeError)
    assert control.requests == [OperatorRequest.HOLD]
    assert not control.alive()  # it was never sent a quit command
    assert not loop.quitting
    assert summary.held == 194  # ticks 6 to 199
    assert [tick.index for tick in log.ticks] == list(range(200))
    assert log.ticks[-1].events[-1] == "end of the run: the control process is gone"
    assert "the planner failed: RuntimeError: out of ideas" in log.ticks[5].events
    (warning,) = capsys.readouterr().err.splitlines()
    assert warning.startswith("the planner failed: RuntimeError: out of ideas; the robot is held")


def test_the_operator_ends_the_run_after_a_failure(
    make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]],
) -> None:
    held = [0]

    def answer(mode: str) -> list[OperatorCommand]:
        held[0] += mode == State.HOLD
        return [OperatorCommand(quit=True)] if held[0] == 20 else []

    control, loop, log = make_loop(operator=ScriptedOperator(answer))
    loop.run()
    assert loop.quitting
    assert control.commands[-1].quit
    assert control.alive()
    assert log.ticks[-1].events[-1] == "end of the run: by the operator"


def test_ctrl_c_twice_damps_after_a_failure(
    make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]],
) -> None:
    def answer(mode: str) -> list[OperatorCommand]:
        if mode == State.HOLD and len(loop.interrupts) < 2:
            loop.interrupts.append(signal.SIGINT)
        return []

    control, loop, _ = make_loop(operator=ScriptedOperator(answer))
    summary = loop.run()
    assert OperatorRequest.ESTOP in control.requests
    assert summary.damped
    assert loop.quitting


@pytest.mark.parametrize("mode", [State.STAND, State.ARMED])
def test_after_ctrl_c_the_operator_cannot_start_the_robot(
    mode: State, make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]]
) -> None:
    requests = (OperatorRequest.ARM, OperatorRequest.RUN, OperatorRequest.HOLD)

    def answer(mode: str) -> list[OperatorCommand]:
        if not loop.interrupts:
            loop.interrupts += [signal.SIGINT] if mode else []
            return []
        return [OperatorCommand(request) for request in requests]

    control, loop, _ = make_loop(fails_at=1000, operator=ScriptedOperator(answer), mode=mode)
    loop.run()
    assert set(control.requests) == {OperatorRequest.HOLD}


@pytest.mark.parametrize("what", ["operator", "log", "screen"])
def test_failure_of_operator_log_or_display_holds_the_robot(
    what: str, make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]]
) -> None:
    calls = [0]

    def answer(mode: str) -> list[OperatorCommand]:
        calls[0] += 1
        if calls[0] > 3:
            raise OSError("the terminal is gone")
        return []

    def show(tick: Tick) -> None:
        if tick.index > 3 and what == "screen":
            raise BrokenPipeError

    operator = ScriptedOperator(answer) if what == "operator" else None
    sink = Broken() if what == "log" else None
    control, loop, _ = make_loop(fails_at=1000, operator=operator, sink=sink)
    summary = loop.run(show)
    assert summary.failure is not None
    assert control.requests == [OperatorRequest.HOLD]
    assert summary.held > 180
    assert not loop.quitting


def test_a_failure_ends_the_run_if_the_robot_does_not_stand_yet(
    make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]],
) -> None:
    control, loop, _ = make_loop(mode=State.INIT)
    assert loop.run().held == 0
    assert loop.quitting
    assert control.commands[-1].quit


def test_ctrl_c_before_the_first_observation_ends_the_run(
    make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def answer(mode: str) -> list[OperatorCommand]:
        loop.interrupts[:] = [signal.SIGINT]
        return []

    control, loop, log = make_loop(operator=ScriptedOperator(answer))
    monkeypatch.setattr(control, "receive", lambda timeout_s=0.0: iter(()))
    loop.run()
    assert loop.quitting
    assert control.commands[-1].quit
    assert log.ticks == []


def test_ctrl_c_before_the_robot_stands_ends_the_run_without_an_emergency_stop(
    make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]],
) -> None:
    def answer(mode: str) -> list[OperatorCommand]:
        loop.interrupts[:] = [signal.SIGINT] * 2 if mode else []
        return []

    control, loop, _ = make_loop(operator=ScriptedOperator(answer), mode=State.INIT)
    loop.run()
    assert control.commands[-1].quit
    assert OperatorRequest.ESTOP not in control.requests


def test_a_control_process_that_ignores_ctrl_c_is_killed(
    make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]],
) -> None:
    def answer(mode: str) -> list[OperatorCommand]:
        loop.interrupts[:] = [signal.SIGINT] * 2 if mode else []
        return []

    control, loop, log = make_loop(operator=ScriptedOperator(answer))
    control.deaf = True
    loop.run()
    assert not loop.quitting, "the watchdog must damp"
    assert len(log.ticks) * TICK_NS == pytest.approx(0.5e9, abs=2.1 * TICK_NS)


def test_events_of_the_planner_are_logged_once(
    make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]],
) -> None:
    control, loop, log = make_loop(fails_at=1000)
    receive = control.receive

    def lossy(timeout_s: float = 0.0) -> Iterator[list[bytes]]:
        """Three observations are lost."""
        if control._tick == 5:
            control._tick = 8
        yield from receive(timeout_s)

    control.receive = lossy  # type: ignore[method-assign]
    summary = loop.run()
    expected = "planner lost 3 observations: recurrence restarted"
    assert [event for tick in log.ticks for event in tick.events].count(expected) == 1
    assert summary.events.count(expected) == 1


def test_all_waiting_observations_are_received_at_once(
    make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]],
) -> None:
    control, loop, log = make_loop(fails_at=1000)
    receive, waiting = control.receive, [100]

    def full(timeout_s: float = 0.0) -> Iterator[list[bytes]]:
        for _ in range(max(1, min(waiting[0], MAX_RECEIVED))):
            yield from receive(timeout_s)
        waiting[0] -= MAX_RECEIVED

    control.receive = full  # type: ignore[method-assign]
    summary = loop.run()
    assert summary.ticks == len(log.ticks) == 200
    assert summary.planned == 101


def test_a_failure_before_the_robot_stands_is_not_reported_as_a_hold(
    make_loop: Callable[..., tuple[ControlStub, PlannerLoop, MemorySink]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    _, loop, _ = make_loop(mode=State.INIT)
    loop.run()
    assert "held" not in capsys.readouterr().err
