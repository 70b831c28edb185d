"""A simulated robot as motors, IMU and camera, without a wire, in lock-step.

Its clock is the simulation: waiting on `SimClock` is what lets time pass, and computing takes
none. So a control loop that runs against the real robot runs unchanged, and bit for bit the same
each time, against this one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from egovcp.log.tick import MotorReadings
from egovcp.rate import NS_PER_S
from egovcp.sim.live import DAMPED, LiveRobot, ServoCommand
from egovcp.spec import PHYSICS_DT
from egovcp_deploy.robots.body import BodyState, MotorCommand, Picture
from egovcp_deploy.robots.remote import Remote

STEP_NS: Final = round(PHYSICS_DT * NS_PER_S)


class SimClock:
    """`Clock` that lets a robot live: every 5 ms of it are one call of ``step``."""

    def __init__(self, step: Callable[[], None]) -> None:
        self._step = step
        self._now_ns = 0

    def now_ns(self) -> int:
        """Nanoseconds of simulated time."""
        return self._now_ns

    def sleep_until(self, deadline_ns: int) -> None:
        """Let whole steps pass up to ``deadline_ns``, and the rest of the time without one."""
        while self._now_ns // STEP_NS < deadline_ns // STEP_NS:
            self._step()
            self._now_ns = (self._now_ns // STEP_NS + 1) * STEP_NS
        self._now_ns = max(self._now_ns, deadline_ns)


class SimBody:
    """`Body` of a `LiveRobot` that is in an episode; its motors obey the last command for ever."""

    def __init__(self, robot: LiveRobot) -> None:
        self._robot = robot
        self._servos = DAMPED
        self._steps = 0
        self._reading: BodyState | None = None
        self._episode = 0
        self.pressed: frozenset[str] = frozenset()
        self.eye = SimEye(self)
        """Its camera."""

    @property
    def robot(self) -> LiveRobot:
        """The simulation."""
        return self._robot

    @property
    def time_ns(self) -> int:
        """Simulated time since this body was made."""
        return self._steps * STEP_NS

    @property
    def episode(self) -> int:
        """Counts the episodes."""
        return self._episode

    @property
    def commanded(self) -> bool:
        """Whether the motors are told to hold anything."""
        return bool(self._servos.stiffness.any())

    def next_episode(self) -> None:
        """The robot has started another episode."""
        self._episode += 1

    def step(self) -> None:
        """Let 5 ms pass."""
        self._robot.drive(self._servos)
        self._robot.advance()
        self._steps += 1
        self._reading = None
        self.eye.read()  # so that each picture is stamped in the step it arrives

    def read(self) -> BodyState:
        """The sensors now; measured once per step."""
        if self._reading is None:
            seen = self._robot.measure()
            self._reading = BodyState(
                time_ns=self.time_ns,
                joint_position=seen.joint_position,
                joint_velocity=seen.joint_velocity,
                quaternion_w=seen.quaternion_w,
                angular_velocity=seen.angular_velocity,
                remote=Remote.asking_for(self._robot.operator_velocity, self.pressed).to_bytes(),
                motors=MotorReadings(seen.torque),
            )
        return self._reading

    def write(self, command: MotorCommand) -> None:
        """From the next step on."""
        self._servos = ServoCommand(command.position, command.stiffness, command.damping)

    def close(self) -> None:
        """Nothing is held."""


class SimEye:
    """`Eye` of a `SimBody`."""

    def __init__(self, body: SimBody) -> None:
        self._body = body
        self._shown: tuple[int, int] | None = None
        self._newest: Picture | None = None

    def read(self) -> Picture:
        """The newest picture that has come out of the camera."""
        taken, depth = self._body.robot.depth_image
        if self._newest is None or (self._body.episode, taken) != self._shown:
            self._shown = (self._body.episode, taken)
            self._newest = Picture(self._body.time_ns, depth)
        return self._newest

    def close(self) -> None:
        """Nothing is held."""
