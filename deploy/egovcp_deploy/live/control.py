"""The 50 Hz loop beneath the planner: read the body, judge, command the motors. It never waits.

Every second control tick t is a planner tick: o_t goes to the planner, whose plan is taken as soon
as it is there, at the latest when o_{t+1} is due. So an action takes effect one or two control
ticks after its observation, as it did in the data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.controllers import LowLevelController
from egovcp.spec import ACTION_BOX, CONTROLLER_TICKS_PER_PLAN
from egovcp_deploy.live import motors
from egovcp_deploy.pilot.motor_watch import MotorVerdict, MotorWatch
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.states import Request, State
from egovcp_deploy.pilot.velocity import VelocityCommand
from egovcp_deploy.robots.base import (
    DepthCamera,
    LowLevelRobot,
    LowState,
    MotorCommand,
    proprioception,
)

Array = NDArray[np.float64]

_BLIND: Final = np.zeros((48, 64), np.uint16)


class Wishes(NamedTuple):
    """What the operator wants at a control tick."""

    request: Request | None = None
    velocity: tuple[float, float, float] | None = None
    """vx, vy (m/s), yaw rate (rad/s); None: nothing new."""


NOTHING: Final = Wishes()


class ControlLoop:
    """One robot's loop; `tick` is called at 50 Hz.

    Args:
        body: motors and IMU.
        eye: depth camera.
        controller: turns commands into joint targets.
        pilot: the state machine and the way to the planner.
        velocity: bounds on what the operator may ask for.
        refusal: why the robot must not be armed; asked at every tick, empty: nothing.
        fault: why the motors must be damped, likewise.
        skipped: what was wrong with the readings since the newest that was used, likewise.
        link: figures about the connection for the log, `Tick.link`; asked at every planner tick.
    """

    def __init__(
        self,
        body: LowLevelRobot,
        eye: DepthCamera,
        controller: LowLevelController,
        pilot: Pilot,
        velocity: VelocityCommand | None = None,
        refusal: Callable[[], str] = lambda: "",
        fault: Callable[[], str] = lambda: "",
        skipped: Callable[[], str] = lambda: "",
        link: Callable[[int], Mapping[str, float]] = lambda now_ns: {},
    ) -> None:
        self._body, self._eye = body, eye
        self._controller = controller
        self.pilot = pilot
        self._velocity = velocity or VelocityCommand()
        self._refusal, self._fault, self._skipped = refusal, fault, skipped
        self._link = link
        self._motor_watch = MotorWatch()
        self._command: MotorCommand | None = None  # the last one written
        self._count = 0
        self._open = False  # o_t is out, a_t is not decided
        self._reading: LowState | None = None
        self._rising_from: Array | None = None
        self._moving: Array = np.zeros(3)

    @property
    def state(self) -> State:
        """Where the state machine is."""
        return self.pilot.supervisor.state

    def tick(self, now_ns: int, wishes: Wishes = NOTHING) -> None:
        """One control tick at ``now_ns``; the motors are told something in every one."""
        reading, picture = self._read(), self._eye.read()
        self._close_planner_tick(now_ns)
        self._steer(now_ns, wishes)
        sent = np.concatenate([self._moving, ACTION_BOX.to_metric(self.pilot.sent)])
        state = None if reading is None else proprioception(reading, sent)
        depth = None if picture is None else picture.depth
        state_ns = None if reading is None else reading.time_ns
        depth_ns = None if picture is None else picture.time_ns
        self.pilot.sense(now_ns, state, depth, state_ns, depth_ns)
        before = self.state
        self._judge(now_ns, wishes.request, reading)
        if state is not None and self._count % CONTROLLER_TICKS_PER_PLAN == 0:
            seen = _BLIND if depth is None else depth
            events = self.pilot.events()
            reported = None if reading is None else reading.motors
            self.pilot.report(
                now_ns, seen, state.astype(np.float32), events, reported, self._link(now_ns)
            )
            self._open = True
        self._command = self._motors(now_ns, before, reading, state)
        self._body.write(self._command)
        self._count += 1

    def _judge(self, now_ns: int, request: Request | None, reading: LowState | None) -> None:
        """Move the state machine on by what the motors report and the operator wants."""
        verdict = MotorVerdict()
        if reading is not None:
            standing = self.state not in (State.INIT, State.DAMP)
            verdict = self._motor_watch.update(reading, self._command, standing)
        self.pilot.note(verdict.events)
        self.pilot.judge(
            now_ns,
            request,
            refusal=self._refusal() or verdict.refusal,
            hold=verdict.hold,
            damp=self._fault() or verdict.damp,
            skipped=self._skipped(),
        )

    def _read(self) -> LowState | None:
        """The newest reading that is all numbers; a broken one would poison the controller."""
        reading = self._body.read()
        if reading is not None and is_finite(reading):
            self._reading = reading
        return self._reading

    def _close_planner_tick(self, now_ns: int) -> None:
        """Take the plan if it is there, or do without once the next observation is due."""
        self.pilot.collect(now_ns)
        due = self._count % CONTROLLER_TICKS_PER_PLAN == 0
        if self._open and (due or self.pilot.answered):
            self.pilot.decide()
            self._open = False

    def _steer(self, now_ns: int, wishes: Wishes) -> None:
        if wishes.velocity is not None:
            self._velocity.wish(now_ns, wishes.velocity)
        self._moving = self._velocity.at(now_ns, allowed=self.state is State.RUN)

    def _motors(
        self, now_ns: int, before: State, reading: LowState | None, state: Array | None
    ) -> MotorCommand:
        mode = 0 if reading is None else reading.mode
        position = None if reading is None else reading.joint_position
        if self.state in (State.INIT, State.DAMP) or state is None or position is None:
            return motors.damped(position, mode)
        if self.state is State.STAND and before is not State.STAND:
            self._rising_from = np.array(position)
            self._controller.reset(state[None])
        target = self._controller.step(state[None])[0]
        if not np.isfinite(target).all():
            self.pilot.judge(now_ns, controller_ok=False)
            return motors.damped(position, mode)
        gains = self._controller.stiffness, self._controller.damping
        if self.state is State.STAND and self._rising_from is not None:
            supervisor = self.pilot.supervisor
            share = supervisor.time_in_state_s(now_ns) / supervisor.limits.stand_s
            return motors.coming_in(self._rising_from, target, *gains, share, mode)
        return motors.following(target, *gains, mode)


def is_finite(reading: LowState) -> bool:
    """Whether a reading is all numbers, with a quaternion that is a rotation."""
    q = np.asarray(reading.quaternion_w)
    parts = (reading.joint_position, reading.joint_velocity, reading.angular_velocity)
    return abs(float(q @ q) - 1.0) < 0.1 and all(np.isfinite(part).all() for part in parts)
