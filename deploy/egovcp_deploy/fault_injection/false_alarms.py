"""The control loop on a healthy simulated robot: nothing may be rejected, and nothing held.

The robot walks where an operator steers it and plays all tasks, in lock-step and with the
simulator's noise. Its readings pass the same checks as those that come over the wire.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings
from egovcp.plan import PolicyStep
from egovcp.rate import LockstepClock
from egovcp.robot.controllers import make_controller
from egovcp.sim.config import evaluation_config
from egovcp.sim.env import privileged_state
from egovcp.sim.live import LiveRobot, Phase, ServoCommand
from egovcp.sim.policies import Oracle
from egovcp.sim.scenario import Scenario
from egovcp.spec import CONTROLLER_HZ, PHYSICS_STEPS_PER_CONTROLLER_TICK
from egovcp_deploy.live.control import ControlLoop, Wishes
from egovcp_deploy.pilot.desk import InlineDesk, Thinker
from egovcp_deploy.pilot.pilot import Pilot
from egovcp_deploy.pilot.states import Request, State
from egovcp_deploy.robots.body import BodyState, MotorCommand, Picture
from egovcp_deploy.robots.fake.bridge import MODE
from egovcp_deploy.robots.plausibility import PlausibilityFilter
from egovcp_deploy.robots.sim_body import STEP_NS

_SETTLE_TICKS: Final = 50
_FALLING: Final = 0.8  # rad; from here on anything may be measured
_STEERED_S: Final = 20.0
_STEERING_TICKS: Final = 100  # between new velocities of the operator, and between pushes
_PUSH: Final = 0.3  # m/s


@dataclass(frozen=True)
class Situation:
    """What the robot does."""

    name: str
    controller: str
    task: str
    steered: bool = False
    """An operator steers it, and it is pushed; the task does not begin."""


SITUATIONS: Final = (
    Situation("steered and pushed", "walk", "ball", steered=True),
    Situation("wall, walk", "walk", "wall"),
    Situation("arch, walk", "walk", "arch"),
    Situation("ball, walk", "walk", "ball"),
    Situation("wall, stance", "stance", "wall"),
    Situation("ball, stance", "stance", "ball"),
)


@dataclass
class Alarms:
    """What happened in one situation."""

    seconds: float = 0.0
    """Simulated, on the robot's feet."""
    readings: int = 0
    rejected: list[str] = field(default_factory=list)
    """Why, of each reading that was rejected."""
    events: list[str] = field(default_factory=list)
    """Changes of the state machine to HOLD or DAMP while the robot was upright."""
    falls: int = 0


class _Body:
    """Motors and sensors of a `LiveRobot` in lock-step, 200 readings a second, each checked."""

    def __init__(self, robot: LiveRobot, clock: LockstepClock, alarms: Alarms) -> None:
        self._robot, self._clock, self._alarms = robot, clock, alarms
        self._filter = PlausibilityFilter()
        self._newest: BodyState | None = None

    def step(self) -> None:
        """Let 5 ms pass, then measure."""
        self._robot.advance()
        self._clock.advance(STEP_NS)
        seen = self._robot.measure()
        reading = BodyState(
            self._clock.now_ns(),
            seen.joint_position,
            seen.joint_velocity,
            seen.quaternion_w,
            seen.angular_velocity,
            mode=MODE,
            motors=MotorReadings(seen.torque),
        )
        problem = self._filter.judge(reading, seen.torque)
        self._alarms.readings += 1
        if problem:
            self._alarms.rejected.append(problem)
        else:
            self._newest = reading

    def read(self) -> BodyState | None:
        """The newest reading that was not rejected."""
        return self._newest

    def write(self, command: MotorCommand) -> None:
        """From the next step on."""
        self._robot.drive(ServoCommand(command.position, command.stiffness, command.damping))

    def close(self) -> None:
        """Nothing is held."""


class _Eye:
    def __init__(self, robot: LiveRobot, clock: LockstepClock) -> None:
        self._robot, self._clock = robot, clock

    def read(self) -> Picture:
        """The newest picture."""
        return Picture(self._clock.now_ns(), self._robot.depth_image[1])

    def close(self) -> None:
        """Nothing is held."""


class _OraclePolicy:
    """Plays the task from the simulator's truth."""

    def __init__(self, robot: LiveRobot) -> None:
        self._robot = robot
        self._oracle = Oracle().by_task

    def reset(self) -> None:
        """Nothing to forget."""

    def act(
        self,
        depth: NDArray[np.uint16],
        state: NDArray[np.floating],
        remaining: Callable[[], float] | None = None,
    ) -> PolicyStep:
        """One action, which is the whole plan."""
        truth = privileged_state([self._robot.instance])
        action = self._oracle[truth.task[0]].act(truth, 0).astype(np.float32)[None]
        return PolicyStep(action, action[:, None], iterations=1)

    def observe(self, depth: NDArray[np.uint16], state: NDArray[np.floating]) -> None:
        """Nothing to remember."""

    def advance(self, sent: NDArray[np.floating]) -> None:
        """Nothing to remember."""


class HealthyRun:
    """Plays one situation.

    Args:
        situation: what the robot does.
        seed: of its scenarios.
    """

    def __init__(self, situation: Situation, seed: int = 0) -> None:
        self._situation, self._seed = situation, seed
        self._rng = np.random.default_rng(seed)
        self._robot = LiveRobot(replace(evaluation_config(), controller=situation.controller))
        self.alarms = Alarms()

    def play(self, episode: int, most_s: float = np.inf) -> None:
        """Play one episode, or ``most_s`` seconds of it, and add what happened to `alarms`."""
        robot, alarms = self._robot, self.alarms
        robot.start(Scenario(self._situation.task, self._seed, episode))
        robot.release()
        clock = LockstepClock()
        body = _Body(robot, clock, alarms)
        body.step()
        pilot = Pilot(InlineDesk(Thinker(_OraclePolicy(robot)), clock), state=State.ARMED)
        controller = make_controller(self._situation.controller)
        loop = ControlLoop(body, _Eye(robot, clock), controller, pilot)
        limit = min(most_s, _STEERED_S if self._situation.steered else np.inf)
        tick, events = 0, list[str]()
        while tick / CONTROLLER_HZ < limit and robot.phase is not Phase.OVER:
            if robot.robot.tilt > _FALLING or loop.state is State.DAMP:
                alarms.falls += robot.robot.tilt > _FALLING
                break
            if tick == _SETTLE_TICKS and not self._situation.steered:
                robot.begin()
            loop.tick(clock.now_ns(), self._wishes(tick))
            events += pilot.events()
            for _ in range(PHYSICS_STEPS_PER_CONTROLLER_TICK):
                body.step()
            tick += 1
        alarms.seconds += tick / CONTROLLER_HZ
        alarms.events += [
            e for e in events if any(f"-> {s}" in e for s in (State.HOLD, State.DAMP))
        ]

    def _wishes(self, tick: int) -> Wishes:
        if tick == 0:
            return Wishes(Request.RUN)
        if not self._situation.steered:
            vx, vy, turn = self._robot.operator_velocity.tolist()
            return Wishes(velocity=(vx, vy, turn))
        if tick % _STEERING_TICKS == 0:
            self._velocity = self._rng.uniform((-0.2, -0.2, -0.5), (0.6, 0.2, 0.5)).tolist()
        if tick % _STEERING_TICKS == _STEERING_TICKS // 2:
            bearing = self._rng.uniform(0, 2 * np.pi)
            self._robot.push(_PUSH * np.array([np.cos(bearing), np.sin(bearing), 0.0]))
        vx, vy, turn = self._velocity if tick >= _STEERING_TICKS else (0.0, 0.0, 0.0)
        return Wishes(velocity=(vx, vy, turn))
