"""A simulated robot under motor commands, in lock-step: the control loop without a wall clock."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings
from egovcp.plan import PolicyStep
from egovcp.robot.stance import StanceController
from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.live import LiveRobot, ServoCommand
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_DIM, JOINT_NAMES
from egovcp_deploy.live.control import ControlLoop
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.planner import ObservationMessage, PlannerRunner
from egovcp_deploy.pilot.states import Limits, OperatorCommand, OperatorRequest, State
from egovcp_deploy.robots.base import DepthImage, LowState, MotorCommand
from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from tests.support.lockstep import DelayedPlanner, LockstepClock
from tests.support.robots.fake_g1 import FakeG1Thread

TICK_NS = 20_000_000
QUICK = [
    *("--robot.limits.stand_s=0.3", "--imagine=0"),
    *("--planner.samples=16", "--planner.elites=4"),
]
#: A busy machine is no fault here.
PATIENT = [
    "--robot.limits.planner_hold_s=5",
    "--robot.limits.misses_hold=10000",
    "--robot.limits.image_hold_s=5",
    "--robot.limits.state_hold_s=5",
    "--robot.limits.state_damp_s=10",
]


#: Nothing happens before the robot.
QUIET = EnvConfig(
    controller="stance",
    ball_episode=EpisodeConfig(ticks=10_000, event_ticks=(9000, 9000), empty_probability=1.0),
)


@pytest.fixture(scope="module")
def robot() -> LiveRobot:
    """On the gantry, before an empty scene."""
    return LiveRobot(QUIET)


@pytest.fixture
def fake(robot: LiveRobot) -> Iterator[FakeBridge]:
    """A fake G1 that a thread steps in real time."""
    robot.start(Scenario("ball", 0, 0))
    found = FakeBridge(robot, Ports(command_port=0, state_port=0, camera_port=0))
    running = FakeG1Thread(found)
    yield found
    running.stop()
    found.close()


@dataclass
class Faults:
    """What is wrong with the readings at the moment."""

    frozen: bool = False
    blind: bool = False
    silent: bool = False
    nan: bool = False
    refusal: str = ""
    hot: float | None = None
    """Temperature of the left knee's motor, deg C."""
    dropped: bool = False
    """The left knee's motor gives no torque."""


KNEE = JOINT_NAMES.index("left_knee_joint")


class SimBody:
    """Motors and IMU of a `LiveRobot`; remembers every command."""

    fault = rejected = ""

    def __init__(self, robot: LiveRobot, clock: LockstepClock, faults: Faults) -> None:
        self._robot, self._clock, self._faults = robot, clock, faults
        self._last: LowState | None = None
        self.commands: list[MotorCommand] = []

    @property
    def refusal(self) -> str:
        return self._faults.refusal

    def read(self) -> LowState | None:
        if self._faults.frozen or self._faults.silent:
            return self._last
        m = self._robot.measure()
        reading = LowState(
            self._clock.now_ns(),
            m.joint_position,
            m.joint_velocity,
            m.quaternion_w,
            m.angular_velocity,
            mode=5,
            motors=MotorReadings(m.torque, self._temperature()),
        )
        if self._faults.nan:
            return replace(reading, joint_velocity=np.full(29, np.nan))
        self._last = reading
        return reading

    def write(self, command: MotorCommand) -> None:
        self.commands.append(command)
        works = (np.arange(29) != KNEE) if self._faults.dropped else np.ones(29)
        self._robot.drive(
            ServoCommand(command.position, works * command.stiffness, works * command.damping)
        )

    def _temperature(self) -> NDArray[np.float64] | None:
        if self._faults.hot is None:
            return None
        return np.where(np.arange(29) == KNEE, self._faults.hot, 35.0)[:, None]

    def close(self) -> None:
        pass


class SimEye:
    """The camera of a `LiveRobot`."""

    def __init__(self, robot: LiveRobot, clock: LockstepClock, faults: Faults) -> None:
        self._robot, self._clock, self._faults = robot, clock, faults
        self._last: DepthImage | None = None

    def read(self) -> DepthImage | None:
        if not self._faults.blind or self._last is None:
            _, depth = self._robot.depth_image
            self._last = DepthImage(self._clock.now_ns(), depth)
        return self._last

    def close(self) -> None:
        pass


class Reaching:
    """A policy whose plan is the same reach always, with the pelvis at its neutral height."""

    def __init__(self, level: float = 0.5) -> None:
        self.level = level
        self.seen: list[NDArray[np.floating]] = []
        self.sent: list[NDArray[np.floating]] = []
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        self.observe(depth, state)
        plan = np.full((1, 4, ACTION_DIM), self.level, np.float32)
        plan[..., -1] = 0.0
        return PolicyStep(plan[:, 0], plan, iterations=1)

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        self.seen.append(state[0].copy())

    def advance(self, sent: NDArray[np.floating]) -> None:
        self.sent.append(sent[0].copy())


class EventPlanner(DelayedPlanner):
    """Remembers the events of all reports."""

    events: list[str]

    def submit(self, observation: ObservationMessage) -> bool:
        self.events += observation.events
        return super().submit(observation)


@dataclass
class Rig:
    """Everything, and the clock that drives it."""

    robot: LiveRobot
    clock: LockstepClock
    faults: Faults
    body: SimBody
    policy: Reaching
    controller: StanceController
    loop: ControlLoop
    events: list[str]
    """Of all reports so far."""
    states: list[State] = field(default_factory=list)

    def run(
        self,
        seconds: float,
        request: OperatorRequest | None = None,
        velocity: tuple[float, float, float] | None = None,
        each: Callable[[int], None] = lambda tick: None,
    ) -> None:
        """Let time pass; the operator's request comes at its first tick."""
        for k in range(round(seconds * 50)):
            each(k)
            command = OperatorCommand(request, velocity) if k == 0 else OperatorCommand()
            self.loop.tick(self.clock.now_ns(), command)
            self.states.append(self.loop.state)
            self.robot.advance(4)
            self.clock.advance(TICK_NS)

    def stand(self) -> None:
        """From the gantry to ARMED, on its own feet."""
        self.run(0.1)
        self.run(3.1, OperatorRequest.STAND)
        self.robot.release()
        self.run(0.5)
        self.run(0.1, OperatorRequest.ARM)
        assert self.loop.state is State.ARMED

    def go(self) -> None:
        """From the gantry to RUN."""
        self.stand()
        self.run(0.5, OperatorRequest.RUN)
        assert self.loop.state is State.RUN


@pytest.fixture
def make_rig() -> Callable[..., Rig]:
    """A robot on the gantry before an empty scene; ``delay_ms`` by tick is the planner's."""

    def make(delay_ms: Callable[[int], int] = lambda tick: 10, level: float = 0.5) -> Rig:
        robot = LiveRobot(QUIET)
        robot.start(Scenario("ball", 0, 0))
        clock, faults, policy = LockstepClock(time_ns=10**12), Faults(), Reaching(level)
        body = SimBody(robot, clock, faults)
        runner = PlannerRunner(policy)
        planner = EventPlanner(runner, lambda tick: delay_ms(tick) * 1_000_000)
        planner.events = []
        controller = StanceController()
        camera = SimEye(robot, clock, faults)
        loop = ControlLoop(body, camera, controller, Pilot(planner, Limits()))
        return Rig(robot, clock, faults, body, policy, controller, loop, planner.events)

    return make
