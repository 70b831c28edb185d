"""The control loop on a healthy simulated robot, to find false alarms.

The robot walks as an operator steers it, and plays all tasks, in lock-step and with sensor noise.
Its readings pass the same checks as those of a robot. None may be rejected, and none may hold.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.plan import PolicyStep
from egovcp.robot.controllers import make_controller
from egovcp.sim.config import evaluation_config
from egovcp.sim.live import LiveRobot, Phase
from egovcp.sim.scenario import Scenario
from egovcp.spec import CONTROLLER_HZ, PHYSICS_STEPS_PER_CONTROLLER_TICK
from egovcp_deploy.live.control import ControlLoop
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.planner import InlinePlanner, PlannerRunner
from egovcp_deploy.pilot.states import OperatorCommand, OperatorRequest, State
from egovcp_deploy.robots.base import LowState, MotorCommand
from egovcp_deploy.robots.fake.bridge import MODE
from egovcp_deploy.robots.plausibility import PlausibilityFilter
from tests.support.lockstep import LockstepClock

from .sim_low_level import STEP_NS, SimLowLevelRobot

_SETTLE_TICKS: Final = 50
_FALLING: Final = 0.8  # rad; beyond it the readings may be implausible
_STEERED_S: Final = 20.0
_STEERING_TICKS: Final = 100  # between new velocities of the operator, and between pushes
_PUSH: Final = 0.3  # m/s


@dataclass(frozen=True)
class Situation:
    """What the robot does, with the walking controller."""

    name: str
    task: str
    steered: bool = False
    """Whether an operator steers the robot, and it is pushed; the task does not begin."""


SITUATIONS: Final = (
    Situation("steered and pushed", "ball", steered=True),
    *(Situation(task, task) for task in ("wall", "arch", "ball")),
)


@dataclass
class Alarms:
    """What happened in one situation."""

    seconds: float = 0.0
    """Simulated time on the robot's feet."""
    readings: int = 0
    rejected: list[str] = field(default_factory=list)
    """Reason of each rejected reading."""
    events: list[str] = field(default_factory=list)
    """Changes of the state machine to HOLD or DAMP while the robot was upright."""
    falls: int = 0


class _CheckedRobot:
    """As `BridgeRobot`, of a `LiveRobot`, with 200 checked readings a second."""

    refusal = fault = rejected = ""

    def __init__(self, robot: LiveRobot, clock: LockstepClock, alarms: Alarms) -> None:
        self._clock, self._alarms = clock, alarms
        self._sim = SimLowLevelRobot(robot, MODE)
        self._filter = PlausibilityFilter()
        self._newest: LowState | None = None
        self.camera = self._sim.camera

    def step(self) -> None:
        """Advance by 5 ms, then measure."""
        self._sim.step()
        self._clock.advance(STEP_NS)
        state = self._sim.read()
        problem = self._filter.check(state)
        self._alarms.readings += 1
        if problem:
            self._alarms.rejected.append(problem)
        else:
            self._newest = state

    def read(self) -> LowState | None:
        """Return the newest reading that was not rejected."""
        return self._newest

    def write(self, command: MotorCommand) -> None:
        """Apply ``command`` from the next step on."""
        self._sim.write(command)

    def close(self) -> None:
        """Do nothing."""


class _OraclePolicy:
    """Plays the task from the simulator's privileged state."""

    def __init__(self, robot: LiveRobot) -> None:
        self._robot = robot

    def reset(self) -> None:
        """Do nothing: there is no memory."""

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """A plan of one action."""
        action = self._robot.instance.task.oracle().astype(np.float32)[None]
        return PolicyStep(action, action[:, None], iterations=1)

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        """Do nothing."""

    def advance(self, sent: NDArray[np.floating]) -> None:
        """Do nothing."""


class HealthyRun:
    """Plays one situation.

    Args:
        situation: controller and task.
        seed: of its scenarios.
    """

    def __init__(self, situation: Situation, seed: int = 0) -> None:
        self._situation, self._seed = situation, seed
        self._rng = np.random.default_rng(seed)
        self._robot = LiveRobot(evaluation_config())
        self.alarms = Alarms()

    def play(self, episode: int, max_s: float = np.inf) -> None:
        """Play one episode, or ``max_s`` seconds of it, and add what happened to `alarms`."""
        robot, alarms = self._robot, self.alarms
        robot.start(Scenario(self._situation.task, self._seed, episode))
        robot.release()
        clock = LockstepClock()
        checked = _CheckedRobot(robot, clock, alarms)
        checked.step()
        pilot = Pilot(InlinePlanner(PlannerRunner(_OraclePolicy(robot))), state=State.ARMED)
        controller = make_controller("walk")
        loop = ControlLoop(checked, checked.camera, controller, pilot)
        limit = min(max_s, _STEERED_S if self._situation.steered else np.inf)
        tick, events = 0, list[str]()
        while tick / CONTROLLER_HZ < limit and robot.phase is not Phase.OVER:
            if robot.robot.tilt > _FALLING or loop.state is State.DAMP:
                alarms.falls += robot.robot.tilt > _FALLING
                break
            if tick == _SETTLE_TICKS and not self._situation.steered:
                robot.begin()
            loop.tick(clock.now_ns(), self._wishes(tick))
            events += pilot.take_events()
            for _ in range(PHYSICS_STEPS_PER_CONTROLLER_TICK):
                checked.step()
            tick += 1
        alarms.seconds += tick / CONTROLLER_HZ
        alarms.events += [
            e for e in events if any(f"-> {s}" in e for s in (State.HOLD, State.DAMP))
        ]

    def _wishes(self, tick: int) -> OperatorCommand:
        if tick == 0:
            return OperatorCommand(OperatorRequest.RUN)
        if not self._situation.steered:
            vx, vy, turn = self._robot.operator_velocity.tolist()
            return OperatorCommand(velocity=(vx, vy, turn))
        if tick % _STEERING_TICKS == 0:
            self._velocity = self._rng.uniform((-0.2, -0.2, -0.5), (0.6, 0.2, 0.5)).tolist()
        if tick % _STEERING_TICKS == _STEERING_TICKS // 2:
            bearing = self._rng.uniform(0, 2 * np.pi)
            self._robot.push(_PUSH * np.array([np.cos(bearing), np.sin(bearing), 0.0]))
        vx, vy, turn = self._velocity if tick >= _STEERING_TICKS else (0.0, 0.0, 0.0)
        return OperatorCommand(velocity=(vx, vy, turn))
