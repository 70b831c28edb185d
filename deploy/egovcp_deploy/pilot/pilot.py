"""Decides each tick what a robot is sent: the planner's action, or a safe one.

A planner tick t of 40 ms is

    sense(readings) -> update_state(operator) -> send_observation(o_t)
                                   ... receive_plans() ... next_action() = a_t

On a robot, plans arrive during the tick, and `sense` and `update_state` run at 50 Hz; in lock-step
simulation all calls follow at once. Nothing here blocks, sleeps or does I/O.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings
from egovcp.robot.stance import pelvis_height
from egovcp.robot_spec import G1, RobotSpec
from egovcp.spec import ACTION_DIM, ACTION_RATE_LIMIT, COMMAND_SLICE, STATE_SLICES
from egovcp_deploy.pilot.planner import ObservationMessage, PlanMessage, PlannerClient
from egovcp_deploy.pilot.states import Facts, Limits, OperatorRequest, State, Supervisor

Array = NDArray[np.float64]

MAX_REPEATS: Final = 5  # rejected actions for which the last one is repeated, before easing
HOLD_RATE: Final = 0.04  # normalised units per tick towards neutral: 1 unit in 1 s
REJECTED: Final = "plan rejected: not finite"
OUTDATED: Final = "plan ignored: not newer than the last one"
UNREQUESTED: Final = "plan rejected: for a future tick"


class PlanBuffer:
    """Keeps the newest usable plan. A plan for tick t holds the actions of t .. t + N - 1, so that
    its later actions bridge plans that are late."""

    def __init__(self) -> None:
        self._plan: Array | None = None
        self._tick = -1
        self.misses = 0  # consecutive ticks without a plan in time

    def offer(self, tick: int, plan: NDArray[np.floating]) -> bool:
        """Take the plan (N, A) made for ``tick``; false if it is not finite or not newer."""
        actions = np.asarray(plan, np.float64)
        if tick <= self._tick or not np.isfinite(actions).all():
            return False
        self._plan, self._tick = actions, tick
        return True

    def has(self, tick: int) -> bool:
        """Whether the plan for ``tick`` itself has arrived."""
        return self._tick == tick

    def action(self, tick: int) -> Array | None:
        """The action (A,) for ``tick``; call it once per tick. None: no plan covers the tick."""
        self.misses = 0 if self.has(tick) else self.misses + 1
        if self._plan is None:
            return None
        ahead = tick - self._tick
        return self._plan[ahead].copy() if 0 <= ahead < len(self._plan) else None


class SafetyFilter:
    """Filters the actions of E robots in step: finite, rate-limited, in the box.

    The limits are those of the data collection, so that the robot stays within the training data.
    An action that is not finite is rejected, before it is clamped: the robot repeats its last
    action, and after `MAX_REPEATS` rejections in a row it eases to the neutral pose.
    """

    def __init__(self, num_envs: int = 1, action_dim: int = ACTION_DIM) -> None:
        self._last: Array = np.zeros((num_envs, action_dim))
        self._rejections: NDArray[np.int64] = np.zeros(num_envs, np.int64)

    def filter(self, planned: NDArray[np.floating]) -> Array:
        """Planned actions (E, A) of any value -> actions that may be sent: in [-1, 1], at most the
        rate limit away from the last."""
        wanted = np.array(planned, np.float64)
        rejected = np.any(~np.isfinite(wanted), axis=1)
        self._rejections = np.where(rejected, self._rejections + 1, 0)
        fallback = np.where(self.holding[:, None], self._eased(), self._last)
        wanted[rejected] = fallback[rejected]
        change = np.clip(wanted - self._last, -ACTION_RATE_LIMIT, ACTION_RATE_LIMIT)
        self._last = np.clip(self._last + change, -1.0, 1.0)
        return self._last.copy()

    def ease(self) -> Array:
        """(E, A) the next action towards the neutral pose."""
        self._last = self._eased()
        return self._last.copy()

    def repeat(self) -> Array:
        """(E, A) the last action once more."""
        return self._last.copy()

    @property
    def holding(self) -> NDArray[np.bool_]:
        """(E,) whether more than `MAX_REPEATS` actions in a row were rejected, so that the robot
        eases to the neutral pose."""
        holding: NDArray[np.bool_] = self._rejections > MAX_REPEATS
        return holding

    def _eased(self) -> Array:
        eased: Array = self._last - np.clip(self._last, -HOLD_RATE, HOLD_RATE)
        return eased


class Freshness:
    """Age of a reading, measured from when its content last changed.

    A driver that has died behind a live connection repeats its last reading with new time stamps.
    Real sensors are noisy: a reading that repeats bit for bit is not new. Depth images without a
    valid pixel are the exception: with nothing in range all of them are equal. With ``repeats``,
    for simulated sensors without noise, every reading counts as new.
    """

    def __init__(self, repeats: bool = False) -> None:
        self._repeats = repeats
        self._content: bytes | None = None
        self._time_ns: int | None = None
        self._changed_ns: int | None = None

    def update(self, time_ns: int, content: NDArray[np.generic] | None) -> None:
        """Take the content read at ``time_ns``; None or content that is not finite is ignored."""
        if content is None or not np.isfinite(content).all():
            return
        raw = content.tobytes()
        if (
            self._repeats
            or raw != self._content
            or (time_ns != self._time_ns and not content.any())
        ):
            self._content, self._changed_ns = raw, time_ns
        self._time_ns = time_ns

    def age_s(self, now_ns: int) -> float:
        """Time since the content last changed, s; infinite before the first reading."""
        return math.inf if self._changed_ns is None else (now_ns - self._changed_ns) / 1e9


def posture(state: NDArray[np.floating]) -> tuple[float, float]:
    """State (74,) -> angle between pelvis and vertical, rad, and height of the pelvis above the
    sole of the lower foot along the vertical, m."""
    s = np.asarray(state, np.float64)
    gravity = s[STATE_SLICES["projected_gravity"]]
    norm = math.sqrt(float(gravity @ gravity))
    tilt = math.acos(min(max(-float(gravity[2]) / max(norm, 1e-9), -1.0), 1.0))
    joints = s[None, STATE_SLICES["joint_position"]]
    return tilt, float(pelvis_height(joints, gravity[None])[0])


class Pilot:
    """Connects one robot with its planner, for one run. ``limits`` and the initial ``state`` are
    those of its `Supervisor`. A ``robot`` of another kind than the G1 is a simulated one, whose
    posture is not supervised."""

    def __init__(
        self,
        planner: PlannerClient,
        limits: Limits | None = None,
        state: State = State.INIT,
        robot: RobotSpec = G1,
    ) -> None:
        self._robot = robot
        self._planner = planner
        self.supervisor = Supervisor(limits, state)
        self.tick = 0  # the planner tick of the next observation, or of the pending action
        self.sent: Array = np.zeros(robot.action_dim)  # a_{t-1}, (A,)
        self._safety = SafetyFilter(1, robot.action_dim)
        self.plans = PlanBuffer()
        repeats = not robot.is_g1
        self._proprioception, self._image = Freshness(repeats), Freshness(repeats)
        self._tilt, self._height = 0.0, 0.74  # rad, m; see `Facts`
        self._unanswered: deque[tuple[int, int]] = deque()  # tick and time of observations, ns
        self._first = True  # the next observation restarts the recurrence
        self._restart_tick = 0  # tick of that observation; older plans are ignored
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
        """Take the newest readings, None if not available: proprioception (74,), which arrived at
        ``state_ns`` (None: now), and a depth image (48, 64), which arrived at ``depth_ns``."""
        measured = None if state is None else np.asarray(state)
        if measured is not None and self._robot.is_g1:
            measured = np.delete(measured, COMMAND_SLICE)  # ours: changes with dead sensors, too
        self._proprioception.update(now_ns if state_ns is None else state_ns, measured)
        self._image.update(now_ns if depth_ns is None else depth_ns, depth)
        if self._robot.is_g1 and measured is not None and np.isfinite(measured).all():
            self._tilt, self._height = posture(np.asarray(state))

    def update_state(self, facts: Facts, request: OperatorRequest | None = None) -> State:
        """Update the state machine and return its state; ``facts`` are those that the pilot does
        not measure: the time, and the results of other checks."""
        before, now_ns, waiting = self.supervisor.state, facts.time_ns, self._unanswered
        facts = replace(
            facts,
            state_age_s=self._proprioception.age_s(now_ns),
            image_age_s=self._image.age_s(now_ns),
            planner_silence_s=(now_ns - waiting[0][1]) / 1e9 if waiting else 0.0,
            misses=self.plans.misses,
            tilt=self._tilt,
            height=self._height,
            planner_alive=self._planner.alive,
        )
        self._events += self.supervisor.update(facts, request)
        if before is State.ARMED and self.supervisor.state is State.RUN:
            self._first = True
            self.plans = PlanBuffer()
        return self.supervisor.state

    def add_events(self, events: Iterable[str]) -> None:
        """Add lines to the log."""
        self._events += events

    def take_events(self) -> tuple[str, ...]:
        """Log lines since the last call."""
        events, self._events = tuple(self._events), []
        return events

    # --- at every planner tick -----------------------------------------------------------
    def send_observation(
        self,
        now_ns: int,
        depth: NDArray[np.uint16],
        state: NDArray[np.float32],
        events: tuple[str, ...] = (),
        motors: MotorReadings | None = None,
        link: Mapping[str, float] | None = None,
    ) -> None:
        """Send o_t, depth (48, 64) mm and state (74,), to the planner, with ``events``, ``motors``
        and ``link`` for its log. If it cannot be sent, ``events`` are kept for `take_events`."""
        if self._first:
            self._restart_tick = self.tick
        observation = ObservationMessage(
            self.tick,
            now_ns,
            depth,
            state,
            self.sent.copy(),
            self._first,
            self.supervisor.state,
            events,
            motors,
            link or {},
        )
        self._first = False
        self._unanswered.append((self.tick, now_ns))
        if not self._planner.submit(observation):
            self._events[:0] = events

    def receive_plans(self, now_ns: int) -> PlanMessage | None:
        """Take the plans that have arrived by ``now_ns``; returns that of this tick, if any, even
        if its actions are rejected."""
        current = None
        for plan in self._planner.poll(now_ns):
            if plan.tick > self.tick:  # it would make all later plans `OUTDATED`
                self._events.append(UNREQUESTED)
                continue
            while self._unanswered and self._unanswered[0][0] <= plan.tick:
                self._unanswered.popleft()
            self._events += plan.events
            if self._first or plan.tick < self._restart_tick:
                continue
            if not self.plans.offer(plan.tick, plan.actions):
                finite = np.isfinite(plan.actions).all()
                self._events.append(OUTDATED if finite else REJECTED)
            if plan.tick == self.tick:
                current = plan
        return current

    def next_action(self) -> Array:
        """a_t (A,); call it once per tick. The next tick begins."""
        wanted = self.plans.action(self.tick)
        if self.supervisor.state is not State.RUN or self._first:
            self.sent = self._safety.ease()[0]
        elif wanted is None:
            self.sent = self._safety.repeat()[0]
        else:
            self.sent = self._safety.filter(wanted[None])[0]
        self.tick += 1
        return self.sent.copy()
