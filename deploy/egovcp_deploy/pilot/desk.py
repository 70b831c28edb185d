"""The planner as the pilot sees it: reports go in, plans come out, at some later time.

    Desk.submit(report of o_t)  ...  Desk.poll() -> reply with a plan made from o_t

`Thinker` is the planner itself: it takes every report into the recurrence, in order, and plans
from the newest only. `InlineDesk` runs it in lock-step with simulated time.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings, ValueMap
from egovcp.plan import Policy, PolicyStep, blank_observation
from egovcp.rate import Clock
from egovcp.spec import ACTION_DIM
from egovcp_deploy.pilot.effort import Effort
from egovcp_deploy.policy import Adjustable, ImaginingPolicy, RolloutPolicy
from egovcp_deploy.value_maps import value_maps

SKIPPED: Final = "observation skipped: its state is not finite, or impossible"
BACKLOG: Final = 8  # reports that may wait for a busy planner; older ones are lost


@dataclass(frozen=True)
class Report:
    """One observation o_t on its way to the planner."""

    tick: int
    """t, planner ticks; counts on without gaps."""
    time_ns: int
    """When o_t was put together, monotonic."""
    depth: NDArray[np.uint16]
    """(48, 64) mm, 0 invalid."""
    state: NDArray[np.float32]
    """(74,) proprioception; its command is the one sent before."""
    sent: NDArray[np.float64]
    """(7,) a_{t-1} as it was sent."""
    first: bool = False
    """Whether the recurrence starts here: from zeros, with a_{t-1} neutral."""
    mode: str = ""
    """State of the robot's state machine now."""
    events: tuple[str, ...] = ()
    """What happened since the last report, for the log."""
    motors: MotorReadings | None = None
    """Of the newest reading, for the log."""
    link: Mapping[str, float] = field(default_factory=dict)
    """`Tick.link`, for the log."""


class Decoded(NamedTuple):
    """Depth pictures decoded for the log, m."""

    reconstructed: NDArray[np.float32] | None
    """(48, 64) the present."""
    imagined: NDArray[np.float32] | None
    """(K, 48, 64) 1..K ticks ahead."""
    value_maps: tuple[ValueMap, ...] = ()


NOTHING_DECODED: Final = Decoded(None, None)


@dataclass(frozen=True)
class Reply:
    """What the planner made of the observation of ``tick``."""

    tick: int
    step: PolicyStep
    """For one robot."""
    plan_ms: float
    """Time to filter and plan."""
    decoded: Decoded = NOTHING_DECODED
    events: tuple[str, ...] = ()
    """What the planner has to tell."""


class Desk(Protocol):
    """Where reports are handed in and replies are fetched. No call blocks."""

    def submit(self, report: Report) -> None:
        """Hand in o_t."""
        ...

    def poll(self, now_ns: int) -> list[Reply]:
        """Replies that have arrived by ``now_ns``, oldest first."""
        ...

    @property
    def alive(self) -> bool:
        """False once the planner is known to be gone."""
        ...


class Thinker:
    """Filters every report and plans from the newest.

    Args:
        policy: for one robot.
        imagine: how many ticks ahead to decode for the log; 0 decodes nothing.
    """

    def __init__(self, policy: RolloutPolicy, imagine: int = 0) -> None:
        self._policy = policy
        self._effort = Effort(policy.config) if isinstance(policy, Adjustable) else None
        self._imagine = imagine
        self._imagining = policy if imagine and isinstance(policy, ImaginingPolicy) else None
        self._next_tick: int | None = None

    def think(
        self, reports: Sequence[Report], remaining: Callable[[], float] | None = None
    ) -> Reply:
        """Take ``reports`` in, in order; plan from the last. A gap between them starts afresh.

        Nothing is decoded yet: see `decode`.

        Args:
            reports: consecutive ticks, at least one.
            remaining: seconds until the plan is due; None: there is no hurry.
        """
        begin = time.perf_counter()
        events = [event for report in reports[:-1] for event in self._take(report)]
        last = reports[-1]
        events += self._begin(last)
        step = self._policy.act(last.depth[None], last.state[None], remaining)
        events += self._skipped()
        plan_ms = (time.perf_counter() - begin) * 1e3
        return Reply(last.tick, step, plan_ms, events=tuple(events))

    def pace(self, reply: Reply, late: bool) -> bool:
        """Told of each plan whether it was late; true if less, or more, is now weighed."""
        if self._effort is None or not self._effort.record(late, reply.step.iterations):
            return False
        assert isinstance(self._policy, Adjustable)
        self._policy.config = self._effort.config
        return True

    @property
    def samples(self) -> int:
        """Candidates per iteration at present; 0 of a policy that does not plan."""
        return 0 if self._effort is None else self._effort.config.samples

    def warm_up(self) -> None:
        """Plan and decode once for nothing: the first time takes long."""
        depth, state = blank_observation(1)
        nothing = Report(0, 0, depth[0], state[0], np.zeros(ACTION_DIM), first=True)
        for _ in range(2):
            self.decode(self.think([nothing]))
        self._next_tick = None

    def _take(self, report: Report) -> list[str]:
        """A report that is too old to plan from."""
        events = self._begin(report)
        self._policy.observe(report.depth[None], report.state[None])
        return events + self._skipped()

    def _skipped(self) -> list[str]:
        """The event of an observation that the policy did not use."""
        policy = self._policy
        return [SKIPPED] if isinstance(policy, Policy) and policy.skipped.any() else []

    def _begin(self, report: Report) -> list[str]:
        gap = self._next_tick is not None and report.tick != self._next_tick
        lost = report.tick - (self._next_tick or 0)
        self._next_tick = report.tick + 1
        if report.first or gap:
            self._policy.reset()
        if not report.first:
            self._policy.advance(report.sent[None])
        return [f"planner lost {lost} observations: starts afresh"] if gap else []

    def decode(self, reply: Reply) -> Reply:
        """``reply`` with pictures for the log, before the recurrence moves on: they show o_t."""
        if self._imagining is None:
            return reply
        film = self._imagining.imagine(reply.step.plan, self._imagine)
        maps: tuple[ValueMap, ...] = ()
        if isinstance(policy := self._policy, Policy):
            maps = value_maps(policy.model, policy.carry, reply.step.action[0])
        decoded = Decoded(self._imagining.reconstruct()[0], film[0], maps)
        return replace(reply, decoded=decoded)


class InlineDesk:
    """The planner in lock-step with simulated time: planning takes no time, or a given one.

    Args:
        thinker: the planner.
        clock: tells when a reply is due.
        delay_ns: how long planning the report of a tick takes in simulated time; a busy planner
            lets reports wait.
    """

    def __init__(
        self, thinker: Thinker, clock: Clock, delay_ns: Callable[[int], int] = lambda tick: 0
    ) -> None:
        self._thinker = thinker
        self._clock = clock
        self._delay_ns = delay_ns
        self._waiting: deque[Report] = deque(maxlen=BACKLOG)
        self._ready: tuple[int, Reply] | None = None

    @property
    def alive(self) -> bool:
        """Always: what fails in this process is raised."""
        return True

    def submit(self, report: Report) -> None:
        """Hand in o_t; an idle planner begins at once."""
        self._waiting.append(report)
        self._begin(self._clock.now_ns())

    def poll(self, now_ns: int) -> list[Reply]:
        """What is due by ``now_ns``."""
        replies = []
        while self._ready is not None and self._ready[0] <= now_ns:
            ready_ns, reply = self._ready
            replies.append(reply)
            self._ready = None
            self._begin(ready_ns)
        return replies

    def _begin(self, now_ns: int) -> None:
        if self._ready is None and self._waiting:
            reports = list(self._waiting)
            self._waiting.clear()
            reply = self._thinker.decode(self._thinker.think(reports))
            self._ready = (now_ns + self._delay_ns(reply.tick), reply)
