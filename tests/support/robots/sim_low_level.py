"""Low-level access to a `LiveRobot` in lock-step: the same control loop as on a robot, repeatable
bit for bit.

`SimClock` is simulated time: waiting on it advances the simulation, and computing takes no time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from egovcp.log.tick import MotorReadings
from egovcp.rate import NS_PER_S
from egovcp.sim.live import DAMPED, LiveRobot, ServoCommand
from egovcp.spec import PHYSICS_DT
from egovcp_deploy.robots.base import DepthImage, LowState, MotorCommand
from egovcp_deploy.robots.wire import RemoteControl

STEP_NS: Final = round(PHYSICS_DT * NS_PER_S)


class SimClock:
    """`Clock` of a simulation that ``step`` advances by 5 ms."""

    def __init__(self, step: Callable[[], None]) -> None:
        self._step = step
        self._now_ns = 0

    def now_ns(self) -> int:
        """Nanoseconds of simulated time."""
        return self._now_ns

    def sleep_until(self, deadline_ns: int) -> None:
        """Take the whole steps up to ``deadline_ns``."""
        while self._now_ns // STEP_NS < deadline_ns // STEP_NS:
            self._step()
            self._now_ns = (self._now_ns // STEP_NS + 1) * STEP_NS
        self._now_ns = max(self._now_ns, deadline_ns)


class SimLowLevelRobot:
    """As `BridgeRobot`, of a `LiveRobot` in an episode; also a robot of `EpisodeSequencer`.

    Args:
        robot: the simulation.
        mode: the mode machine that it reports.
    """

    refusal = fault = rejected = ""

    def __init__(self, robot: LiveRobot, mode: int = 0) -> None:
        self.robot = robot
        self.pressed: frozenset[str] = frozenset()
        self.camera = SimDepthCamera(self)
        self._mode = mode
        self._servos = DAMPED
        self._steps = 0
        self._state: LowState | None = None

    @property
    def time_ns(self) -> int:
        """Simulated time since construction."""
        return self._steps * STEP_NS

    @property
    def commanded(self) -> bool:
        """Whether the last command has stiffness, so that the motors hold a pose."""
        return bool(self._servos.stiffness.any())

    def step(self) -> None:
        """Advance by 5 ms."""
        self.robot.drive(self._servos)
        self.robot.advance()
        self._steps += 1
        self._state = None
        self.camera.read()  # so that each image is stamped in the step in which it arrives

    def read(self) -> LowState:
        """Return the sensors' current reading, measured once per step."""
        if self._state is None:
            measured = self.robot.measure()
            remote = RemoteControl.from_velocity(self.robot.operator_velocity, self.pressed)
            self._state = LowState(
                time_ns=self.time_ns,
                joint_position=measured.joint_position,
                joint_velocity=measured.joint_velocity,
                quaternion_w=measured.quaternion_w,
                angular_velocity=measured.angular_velocity,
                mode=self._mode,
                remote=remote.to_bytes(),
                motors=MotorReadings(measured.torque),
            )
        return self._state

    def write(self, command: MotorCommand) -> None:
        """Apply ``command`` from the next step on."""
        self._servos = ServoCommand(command.position, command.stiffness, command.damping)

    def close(self) -> None:
        """Do nothing."""


class SimDepthCamera:
    """The depth camera of a `SimLowLevelRobot`."""

    def __init__(self, robot: SimLowLevelRobot) -> None:
        self._robot = robot
        self._newest: DepthImage | None = None

    def read(self) -> DepthImage:
        """Return the newest image that has come out of the camera."""
        _, depth = self._robot.robot.depth_image
        if self._newest is None or self._newest.depth is not depth:
            self._newest = DepthImage(self._robot.time_ns, depth)
        return self._newest

    def close(self) -> None:
        """Do nothing."""
