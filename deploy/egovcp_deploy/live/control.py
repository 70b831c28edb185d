"""The 50 Hz control loop: read the body, update the state machine, command the motors.

Every second control tick is a planner tick t: o_t goes to the planner, whose plan is taken as soon
as it arrives, at the latest when o_{t+1} is due. So an action takes effect one or two control ticks
after its observation, within the 0 to 2 ticks of the training data. The loop never blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.controllers import LowLevelController
from egovcp.robot.g1 import DAMPING, STIFFNESS
from egovcp.robot.kinematics import TARGET_HIGH, TARGET_LOW
from egovcp.spec import ACTION_BOX, CONTROLLER_TICKS_PER_PLAN, NUM_JOINTS
from egovcp_deploy.live.hardware import AnyCamera
from egovcp_deploy.pilot.motor_watch import MotorVerdict, MotorWatch
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.states import Facts, OperatorCommand, OperatorRequest, State
from egovcp_deploy.robots.base import Array, LowState, MotorCommand, proprioception
from egovcp_deploy.robots.bridge import BridgeRobot

#: N m s/rad in DAMP: legs and waist let a standing robot sink in about a second.
DAMP_GAINS: Final = np.concatenate([np.full(15, 8.0), np.full(NUM_JOINTS - 15, 2.0)])
#: Bounds of vx, vy (m/s) and yaw rate (rad/s) in the heading frame, which the walking controller is
#: evaluated at (docs/lowlevel.md), and of their change per s.
VELOCITY_LOW: Final = (-0.3, -0.2, -0.6)
VELOCITY_HIGH: Final = (0.8, 0.2, 0.6)
VELOCITY_RAMP: Final = (1.0, 1.0, 2.0)
_VELOCITY_TIMEOUT_S: Final = 0.5  # an older target counts as zero
_MIDDLE: Final = (TARGET_LOW + TARGET_HIGH) / 2
_NO_IMAGE: Final = np.zeros((48, 64), np.uint16)
_NO_COMMAND: Final = OperatorCommand()


# --- motor commands: all targets are finite and within `TARGET_LOW` and `TARGET_HIGH` -----------
def _bounded(position: NDArray[np.floating]) -> Array:
    """(29,) rad; numbers that are not finite become the middle of the joint's range."""
    p = np.asarray(position, np.float64)
    return np.clip(np.where(np.isfinite(p), p, _MIDDLE), TARGET_LOW, TARGET_HIGH)


def damping_command(position: NDArray[np.floating] | None, mode: int) -> MotorCommand:
    """Damping without stiffness; ``position`` (29,) rad of the joints, None: unknown."""
    where = np.zeros(NUM_JOINTS) if position is None else position
    return MotorCommand(_bounded(where), np.zeros(NUM_JOINTS), DAMP_GAINS, mode)


def ramp_command(
    start: Array, target: Array, stiffness: Array, damping: Array, share: float, mode: int
) -> MotorCommand:
    """Ramp of the gains: at ``share`` 0 damped at ``start`` (29,) rad, at 1 full gains towards
    ``target`` (29,) rad."""
    share = min(max(share, 0.0), 1.0)
    position = (1 - share) * _bounded(start) + share * _bounded(target)
    damping = (1 - share) * DAMP_GAINS + share * damping
    return MotorCommand(position, share * stiffness, damping, mode)


# --- base velocity -----------------------------------------------------------------------
class VelocityCommand:
    """The operator's base velocity: bounded, ramped, and zero when the operator falls silent."""

    def __init__(self) -> None:
        self._target: Array = np.zeros(3)
        self._target_ns: int | None = None
        self._warned = False
        self._command: Array = np.zeros(3)
        self._last_ns: int | None = None

    def set_target(self, time_ns: int, velocity: NDArray[np.floating] | tuple[float, ...]) -> str:
        """Request ``velocity`` (3,); one of another shape or not finite is ignored. Returns a
        warning at the first velocity that is outside the bounds; else empty."""
        target = np.asarray(velocity, np.float64)
        if target.shape != (3,) or not np.isfinite(target).all():
            return ""
        self._target = np.clip(target, VELOCITY_LOW, VELOCITY_HIGH)
        self._target_ns = time_ns
        if self._warned or np.array_equal(self._target, target):
            return ""
        self._warned = True
        asked, sent = (", ".join(f"{v:g}" for v in x) for x in (target, self._target))
        return (
            f"warning: velocity ({asked}) is outside the bounds of the controller; ({sent}) is "
            "commanded, and likewise from now on"
        )

    def at(self, time_ns: int, allowed: bool = True) -> Array:
        """(3,) the velocity to command now; ``allowed``: whether the robot may move."""
        timeout_ns = _VELOCITY_TIMEOUT_S * 1e9
        silent = self._target_ns is None or time_ns - self._target_ns > timeout_ns
        target = np.zeros(3) if silent or not allowed else self._target
        elapsed = 0.0 if self._last_ns is None else max(0.0, (time_ns - self._last_ns) / 1e9)
        step = np.asarray(VELOCITY_RAMP) * elapsed
        self._command = self._command + np.clip(target - self._command, -step, step)
        self._last_ns = time_ns
        return self._command.copy()


class ControlLoop:
    """The loop of one robot; call `tick` at 50 Hz. ``link`` returns `Tick.link` for the log and is
    called at every planner tick."""

    def __init__(
        self,
        body: BridgeRobot,
        camera: AnyCamera,
        controller: LowLevelController,
        pilot: Pilot,
        link: Callable[[int], Mapping[str, float]] = lambda now_ns: {},
    ) -> None:
        self._body, self._camera = body, camera
        self._controller = controller
        self.pilot = pilot
        self._link = link
        self._velocity = VelocityCommand()
        self._motor_watch = MotorWatch()
        self._command: MotorCommand | None = None  # the last one written
        self.commanding = False  # whether the last tick wrote a motor command
        self._count = 0
        self._pending = False  # o_t has been sent, a_t is not decided
        self._reading: LowState | None = None
        self._ramp_start: Array = np.zeros(NUM_JOINTS)  # where STAND began

    @property
    def state(self) -> State:
        """State of the state machine."""
        return self.pilot.supervisor.state

    def tick(self, now_ns: int, command: OperatorCommand = _NO_COMMAND) -> None:
        """One control tick at ``now_ns``. It writes a motor command, but in INIT only while
        `BridgeRobot.refusal` is empty: another program may balance the robot."""
        reading, image = self._read(), self._camera.read()
        planner_tick = self._count % CONTROLLER_TICKS_PER_PLAN == 0
        self.pilot.receive_plans(now_ns)
        if self._pending and (planner_tick or self.pilot.plans.has(self.pilot.tick)):
            self.pilot.next_action()
            self._pending = False
        if command.velocity is not None:
            warning = self._velocity.set_target(now_ns, command.velocity)
            self.pilot.add_events([warning] if warning else [])
        velocity = self._velocity.at(now_ns, allowed=self.state is State.RUN)
        sent = np.concatenate([velocity, ACTION_BOX.to_metric(self.pilot.sent)])
        state = None if reading is None else proprioception(reading, sent)
        depth = None if image is None else image.depth
        state_ns = None if reading is None else reading.time_ns
        self.pilot.sense(now_ns, state, depth, state_ns, None if image is None else image.time_ns)
        before = self.state
        self._update_state(now_ns, command.request, reading)
        if reading is not None and state is not None and planner_tick:
            self.pilot.send_observation(
                now_ns,
                _NO_IMAGE if depth is None else depth,
                state.astype(np.float32),
                self.pilot.take_events(),
                reading.motors,
                self._link(now_ns),
            )
            self._pending = True
        motor_command = self._motor_command(now_ns, before, reading, state)
        self.commanding = self.state is not State.INIT or not self._body.refusal
        if self.commanding:
            self._command = motor_command
            self._body.write(motor_command)
        self._count += 1

    def _read(self) -> LowState | None:
        """The newest reading that is finite and has a rotation; others would corrupt the state of
        the controller."""
        reading = self._body.read()
        if reading is not None:
            q = np.asarray(reading.quaternion_w)
            parts = (reading.joint_position, reading.joint_velocity, reading.angular_velocity)
            if abs(float(q @ q) - 1.0) < 0.1 and all(np.isfinite(part).all() for part in parts):
                self._reading = reading
        return self._reading

    def _update_state(
        self, now_ns: int, request: OperatorRequest | None, reading: LowState | None
    ) -> None:
        verdict = MotorVerdict()
        if reading is not None:
            standing = self.state not in (State.INIT, State.DAMP)
            verdict = self._motor_watch.update(reading, self._command, standing)
        self.pilot.add_events(verdict.events)
        facts = Facts(
            now_ns,
            refusal=self._body.refusal or verdict.arming_refusal,
            hold=verdict.hold,
            damp=self._body.fault or verdict.damp,
            skipped=self._body.rejected,
        )
        self.pilot.update_state(facts, request)

    def _motor_command(
        self, now_ns: int, before: State, reading: LowState | None, state: Array | None
    ) -> MotorCommand:
        if reading is None or state is None:
            return damping_command(None, 0)
        position, mode = reading.joint_position, reading.mode
        if self.state in (State.INIT, State.DAMP):
            return damping_command(position, mode)
        if self.state is State.STAND and before is not State.STAND:
            self._ramp_start = np.array(position)
            self._controller.reset(state[None])
        target = self._controller.step(state[None])[0]
        if not np.isfinite(target).all():
            self.pilot.update_state(Facts(now_ns, controller_ok=False))
            return damping_command(position, mode)
        share = 1.0
        if self.state is State.STAND:
            supervisor = self.pilot.supervisor
            share = supervisor.time_in_state_s(now_ns) / supervisor.limits.stand_s
        return ramp_command(self._ramp_start, target, STIFFNESS, DAMPING, share, mode)
