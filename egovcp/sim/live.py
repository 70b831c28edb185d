"""One simulated robot and its task under motor commands, in steps of 5 ms.

Unlike `VectorEnv` it has no low-level controller: the caller sends motor commands, as to a real
robot. Time passes only in `LiveRobot.advance`.

    HELD  ->  FREE  ->  EPISODE  ->  OVER
    gantry    stands    task runs    fallen, or at the time limit; physics goes on
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.robot.controllers import make_controller
from egovcp.robot.g1 import DAMPING
from egovcp.sim.base_env import reporting_plugin_errors
from egovcp.sim.camera import RayCastCamera
from egovcp.sim.instance import EnvInstance, settle
from egovcp.sim.robot import Proprioception, SimulatedRobot
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import PARTS
from egovcp.sim.tasks.base import PHYSICS_STEPS_PER_TICK
from egovcp.spec import (
    ACTION_BOX,
    CONTROLLER_HZ,
    NUM_JOINTS,
    PHYSICS_DT,
    STATE_DIM,
    STATE_SLICES,
)

if TYPE_CHECKING:
    from egovcp.sim.config import EnvConfig

Array = NDArray[np.float64]

GRAVITY: Final = 9.81  # m/s^2
_IMAGE_STEPS: Final = 6  # 30 ms, nearest to the 30 Hz of a D435i


class Phase(Enum):
    """Phase of an episode."""

    HELD = "held"
    """A gantry holds the pelvis where the robot would stand."""
    FREE = "free"
    """The robot is on its own feet; the task has not begun."""
    EPISODE = "episode"
    OVER = "over"


@dataclass(frozen=True)
class ServoCommand:
    """Command of a servo: torque = kp (q* - q) + kd (dq* - dq) + tau; (29,) each."""

    position: Array  # rad
    stiffness: Array  # N m/rad
    damping: Array  # N m s/rad
    velocity: Array = field(default_factory=lambda: np.zeros(NUM_JOINTS))  # rad/s
    torque: Array = field(default_factory=lambda: np.zeros(NUM_JOINTS))  # N m


#: The motors only damp.
DAMPED: Final = ServoCommand(np.zeros(NUM_JOINTS), np.zeros(NUM_JOINTS), DAMPING)


@dataclass(frozen=True)
class Measurement:
    """A noisy reading of the robot's sensors."""

    joint_position: Array  # (29,) rad
    joint_velocity: Array  # (29,) rad/s
    torque: Array  # (29,) N m, as the motors applied it
    quaternion_w: Array  # (4,) pelvis, wxyz
    angular_velocity: Array  # (3,) rad/s, pelvis frame
    acceleration: Array  # (3,) m/s^2, pelvis frame; gravity's share alone


@dataclass
class EpisodeOutcome:
    """Result of an episode, up to now."""

    scenario: Scenario
    ticks: int = 0  # Planner ticks of 40 ms
    success: bool = False
    fallen: bool = False
    reward_terms: dict[str, float] = field(default_factory=dict)
    """Sum of each term; pose costs are those of the measured pose, as actions are unknown."""
    contacts: dict[str, float] = field(default_factory=dict)
    """Part of the robot -> its greatest force on the task's object, N."""

    @property
    def reward(self) -> float:
        """Sum of all terms."""
        return float(sum(self.reward_terms.values()))


class LiveRobot:
    """Plays scenarios with one robot.

    Args:
        config: scenes, sensors and randomisation; of its controller only the standing pose is
            used, and whether it walks.

    Raises:
        UsageError: the controller is unknown.
        ArtifactError: its file cannot be used.
        EnvironmentFailure: the controller does not keep the robot standing.
    """

    def __init__(self, config: EnvConfig) -> None:
        controller = make_controller(config.controller)
        self.config = config
        self._walks = controller.walks
        self._camera = RayCastCamera(config.camera)
        self._standing = settle(config, controller)
        self._instance: EnvInstance | None = None

    @reporting_plugin_errors()
    def start(self, scenario: Scenario) -> None:
        """Hold the robot up in the scene of ``scenario``, with damped motors.

        Raises:
            UsageError: the task needs a controller that walks, and this one does not.
        """
        self.config.require_walking(scenario.task, self._walks)
        if self._instance is None:
            self._instance = EnvInstance(
                self.config, self._camera, self._standing, scenario, render_depth=False
            )
        else:
            self._instance.start(scenario)
        self.phase = Phase.HELD
        self.steps = 0
        """Physics steps since `start`."""
        self.outcome = EpisodeOutcome(scenario)
        rng = scenario.rng("proprioception")
        self._sensors = Proprioception(self.config.sensors, self.robot.index, rng)
        self._measured = np.zeros(STATE_DIM)
        self._images: deque[tuple[int, NDArray[np.uint16]]] = deque([(0, self.instance.render())])
        self.drive(DAMPED)

    @property
    def instance(self) -> EnvInstance:
        """The episode and its sensors."""
        assert self._instance is not None, "start an episode first"
        return self._instance

    @property
    def robot(self) -> SimulatedRobot:
        """The physics."""
        return self.instance.robot

    @property
    def operator_velocity(self) -> Array:
        """(3,) base velocity that an operator commands now: vx, vy (m/s), yaw rate (rad/s)."""
        return self.instance.task.velocity_command if self.phase is Phase.EPISODE else np.zeros(3)

    def release(self) -> None:
        """Release the robot from the gantry."""
        if self.phase is Phase.HELD:
            self.phase = Phase.FREE

    @reporting_plugin_errors()
    def begin(self) -> None:
        """Start the task around the robot at its current pose."""
        self.instance.task.place()
        self.robot.refresh_poses()
        self.phase = Phase.EPISODE

    def push(self, velocity: Array) -> None:
        """Change the velocity of the base at once, (3,) m/s, world."""
        self.robot.data.qvel[:3] += velocity

    def drive(self, command: ServoCommand) -> None:
        """Set the motor command until the next call; effort limits apply."""
        model, physics = self.robot.model, self.instance.physics
        stiffness = command.stiffness * physics["stiffness_scale"]
        damping = command.damping * physics["damping_scale"]
        model.actuator_gainprm[:, 0] = 1.0
        model.actuator_biasprm[:, 1] = -stiffness
        model.actuator_biasprm[:, 2] = -damping
        feed = stiffness * command.position + damping * command.velocity + command.torque
        self.robot.data.ctrl[:] = feed

    def advance(self, steps: int = 1) -> None:
        """Simulate ``steps`` of 5 ms."""
        for _ in range(steps):
            if self.phase is Phase.EPISODE:
                self._step_task()
            else:
                self._step_physics()
            self.steps += 1
            if self.steps % _IMAGE_STEPS == 0:
                self.robot.refresh_poses()
                self._images.append((self.steps, self.instance.render()))

    def _step_physics(self) -> None:
        self.robot.step()
        if self.phase is not Phase.OVER:
            self.instance.require_valid_physics()
        if self.phase is Phase.HELD:
            data = self.robot.data
            data.qpos[:3] = self._standing.position
            data.qpos[3:7] = self._standing.quaternion
            data.qvel[:6] = 0.0
        elif self.phase is Phase.FREE and self.instance.task.has_fallen():
            self.outcome.fallen = True
            self.phase = Phase.OVER

    def _step_task(self) -> None:
        self.instance.step()
        if self.instance.task.physics_steps % PHYSICS_STEPS_PER_TICK:
            return
        totals = self.outcome.reward_terms
        for name, value in self.instance.end_tick(self._pose()).items():
            totals[name] = totals.get(name, 0.0) + value
        self._record()
        if self.instance.done:
            self.phase = Phase.OVER

    def _record(self) -> None:
        instance, outcome = self.instance, self.outcome
        outcome.ticks, outcome.fallen = instance.tick, instance.terminated
        outcome.success = instance.task.success
        for part, force in zip(PARTS, instance.task.forces.tolist(), strict=True):
            if force > 0.0:
                outcome.contacts[part] = max(force, outcome.contacts.get(part, 0.0))

    def _pose(self) -> Array:
        """(7,) the action that commands the robot's present pose, in [-1, 1]."""
        pose = np.append(self.robot.palms_b.ravel(), self.robot.pelvis_height)
        return np.clip(ACTION_BOX.to_normalised(pose), -1.0, 1.0)

    def measure(self) -> Measurement:
        """A fresh reading of the sensors."""
        data, state = self.robot.data, self._measured
        self._sensors.measure(data, state)
        gravity = state[STATE_SLICES["projected_gravity"]]
        return Measurement(
            joint_position=state[STATE_SLICES["joint_position"]].copy(),
            joint_velocity=state[STATE_SLICES["joint_velocity"]].copy(),
            torque=data.actuator_force.copy(),
            quaternion_w=_tilted(data.qpos[3:7], self.robot.rotation, gravity),
            angular_velocity=state[STATE_SLICES["angular_velocity"]].copy(),
            acceleration=-GRAVITY * gravity,
        )

    @property
    def depth_image(self) -> tuple[int, NDArray[np.uint16]]:
        """The newest available depth image and the physics step at which it was rendered.

        Available after the episode's image delay, less the mean 20 ms to the next planner tick.
        """
        late = max(0, self.instance.image_age - 1) / CONTROLLER_HZ / PHYSICS_DT
        while len(self._images) > 1 and self._images[1][0] + late <= self.steps:
            self._images.popleft()
        return self._images[0]


def _tilted(quaternion: Array, rotation: Array, gravity: Array) -> Array:
    """(4,) ``quaternion``, turned by the smallest angle that makes gravity the measured one (3,).

    For unit vectors near each other, measured g' and true g in the pelvis frame, the rotation
    vector is g' x g.
    """
    turn = np.array([1.0, *(np.cross(gravity, -rotation[2]) / 2.0)])
    out = np.empty(4)
    mujoco.mju_mulQuat(out, quaternion, turn)
    return np.asarray(out / np.linalg.norm(out))
