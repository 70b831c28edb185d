"""The planner's loop without processes: what it orders when something in it fails."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest

from egovcp.errors import EnvironmentFailure
from egovcp.log.tick import Tick
from egovcp.plan import PolicyStep
from egovcp.rate import LockstepClock
from egovcp.spec import ACTION_DIM, STATE_DIM
from egovcp_deploy.live.link import Order, decode_order, encode_report
from egovcp_deploy.live.planner import LiveSummary, PlannerLoop
from egovcp_deploy.pilot.desk import Report, Thinker
from egovcp_deploy.pilot.states import Request, State
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


class Control:
    """The control process at the other end of the link: a report every tick, RUN until HOLD."""

    def __init__(self, clock: LockstepClock, mode: State, ticks: int) -> None:
        self._clock, self.mode, self._ticks = clock, mode, ticks
        self._tick = 0
        self.orders: list[Order] = []

    def alive(self) -> bool:
        return self._tick < self._ticks

    def send(self, parts: Sequence[bytes]) -> bool:
        order = decode_order(parts) if len(parts) == 1 else None
        if order is not None:
            self.orders.append(order)
            if order.request is Request.HOLD and self.mode is State.RUN:
                self.mode = State.HOLD
            if order.request is Request.ESTOP:
                self.mode = State.DAMP
        return True

    def receive(self, timeout_s: float = 0.0) -> Iterator[list[bytes]]:
        self._clock.advance(TICK_NS)
        depth, state = np.zeros((48, 64), np.uint16), np.zeros(STATE_DIM, np.float32)
        sent = np.zeros(ACTION_DIM)
        now = self._clock.now_ns()
        yield encode_report(Report(self._tick, now, depth, state, sent, self._tick == 0, self.mode))
        self._tick += 1

    @property
    def asked(self) -> list[Request]:
        return [order.request for order in self.orders if order.request is not None]


class Person:
    """An operator whose answers are decided by the test."""

    def __init__(self, answer: Callable[[str], list[Order]] = lambda mode: []) -> None:
        self._answer = answer

    def orders(self, now_ns: int, mode: str) -> list[Order]:
        return self._answer(mode)


class Broken(MemorySink):
    """A log that fails at its third tick and from then on."""

    def write(self, tick: Tick) -> None:
        super().write(tick)
        if len(self.ticks) > 2:
            raise EnvironmentFailure("no paper")


@pytest.fixture
def told() -> list[str]:
    return []


@pytest.fixture
def fly(told: list[str]) -> Callable[..., tuple[Control, PlannerLoop, MemorySink]]:
    """A loop whose planner fails in tick 5, before a control process that lives 200 ticks."""

    def make(
        fails_at: int = 5,
        operator: Person | None = None,
        sink: MemorySink | None = None,
        mode: State = State.RUN,
        stands: bool = True,
    ) -> tuple[Control, PlannerLoop, MemorySink]:
        clock = LockstepClock(time_ns=10**12)
        control, log = Control(clock, mode, 200), sink or MemorySink()
        loop = PlannerLoop(
            Thinker(Still(fails_at)),
            control,  # type: ignore[arg-type]
            operator or Person(),
            log,
            clock,
            control.alive,
            stands=stands,
            tell=told.append,
        )
        return control, loop, log

    return make


def test_a_planner_that_raises_holds_the_robot_and_goes_on_listening_and_logging(
    fly: Callable[..., tuple[Control, PlannerLoop, MemorySink]], told: list[str]
) -> None:
    control, loop, log = fly()
    summary = loop.run()
    assert isinstance(summary.failure, RuntimeError)
    assert control.asked == [Request.HOLD]
    assert not control.alive()  # it was never told to end
    assert not loop.quitting
    assert summary.held == 194  # ticks 6 to 199
    assert [tick.index for tick in log.ticks] == list(range(200))
    assert log.ticks[-1].events[-1] == "end of the run: the control process is gone"
    assert "the planner failed: RuntimeError: out of ideas" in log.ticks[5].events
    assert len(told) == 1
    assert told[0].startswith("the planner failed: RuntimeError: out of ideas; the robot is held")


def test_the_operator_ends_it_afterwards(
    fly: Callable[..., tuple[Control, PlannerLoop, MemorySink]],
) -> None:
    held = [0]

    def answer(mode: str) -> list[Order]:
        held[0] += mode == State.HOLD
        return [Order(quit=True)] if held[0] == 20 else []

    control, loop, log = fly(operator=Person(answer))
    loop.run()
    assert loop.quitting
    assert control.orders[-1].quit
    assert control.alive()
    assert log.ticks[-1].events[-1] == "end of the run: by the operator"


def test_ctrl_c_twice_damps_afterwards(
    fly: Callable[..., tuple[Control, PlannerLoop, MemorySink]],
) -> None:
    def answer(mode: str) -> list[Order]:
        loop.interrupts.count += mode == State.HOLD and loop.interrupts.count < 2
        return []

    control, loop, _ = fly(operator=Person(answer))
    summary = loop.run()
    assert Request.ESTOP in control.asked
    assert summary.damped
    assert loop.quitting


@pytest.mark.parametrize("what", ["operator", "log", "screen"])
def test_whatever_else_fails_holds_too(
    what: str, fly: Callable[..., tuple[Control, PlannerLoop, MemorySink]]
) -> None:
    asked = [0]

    def answer(mode: str) -> list[Order]:
        asked[0] += 1
        if asked[0] > 3:
            raise OSError("the terminal is gone")
        return []

    def show(tick: Tick) -> None:
        if tick.index > 3 and what == "screen":
            raise BrokenPipeError

    operator = Person(answer) if what == "operator" else None
    sink = Broken() if what == "log" else None
    control, loop, _ = fly(fails_at=1000, operator=operator, sink=sink)
    summary = loop.run(show)
    assert summary.failure is not None
    assert control.asked == [Request.HOLD]
    assert summary.held > 180
    assert not loop.quitting


@pytest.mark.parametrize("mode", [State.INIT, State.RUN])
def test_it_ends_by_itself_where_nothing_stands_or_the_robot_is_simulated(
    mode: State, fly: Callable[..., tuple[Control, PlannerLoop, MemorySink]]
) -> None:
    control, loop, _ = fly(mode=mode, stands=mode is State.INIT)
    summary: LiveSummary = loop.run()
    assert loop.quitting
    assert control.orders[-1].quit
    assert summary.held == (0 if mode is State.INIT else pytest.approx(50, abs=3))
