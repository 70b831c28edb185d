"""One instance of the vectorised environment: a robot, its episode, its sensors and delays."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure, SimulationDiverged
from egovcp.robot.controllers import LowLevelController
from egovcp.robot.stance_table import StandingPose, standing_pose
from egovcp.sim.base_env import BaseInstance
from egovcp.sim.camera import DepthNoise, RayCastCamera, RayCaster
from egovcp.sim.config import RandomisationConfig, SensorConfig
from egovcp.sim.robot import Proprioception, SimulatedRobot
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import HANDS, Scene, build_scene
from egovcp.sim.tasks.base import PHYSICS_STEPS_PER_TICK
from egovcp.sim.tasks.registry import DEFAULT_TASK, find_task
from egovcp.spec import (
    ACTION_BOX,
    COMMAND_SLICE,
    CONTROLLER_HZ,
    CONTROLLER_TICKS_PER_PLAN,
    DEPTH_COLS,
    DEPTH_ROWS,
    NUM_JOINTS,
    PHYSICS_STEPS_PER_CONTROLLER_TICK,
    STATE_DIM,
)

if TYPE_CHECKING:
    from egovcp.sim.config import EnvConfig
    from egovcp.sim.tasks.base import Task

Array = NDArray[np.float64]

_NO_IMAGE: Final = np.zeros((DEPTH_ROWS, DEPTH_COLS), dtype=np.uint16)
_SETTLE_TICKS: Final = 100  # controller ticks, 2 s
_LEAST_HEIGHT: Final = 0.6  # m, pelvis of a robot that stands
_NOISELESS: Final = SensorConfig(0.0, 0.0, 0.0, 0.0)
#: Ranges in `RandomisationConfig`; their order is part of what is sampled.
_PHYSICS: Final = ("friction", "payload", "mass_scale", "stiffness_scale", "damping_scale")


def sample_physics(config: RandomisationConfig, scenario: Scenario) -> dict[str, float]:
    """The physical parameters of ``scenario``, each uniform in the range of that name."""
    rng = scenario.rng("physics")
    return {name: float(rng.uniform(*getattr(config, name))) for name in _PHYSICS}


def apply_physics(physics: dict[str, float], scene: Scene, model: mujoco.MjModel) -> None:
    """Write ``physics`` into ``model``, starting from the pristine values of ``scene``."""
    pristine, index = scene.model, scene.index
    model.geom_friction[index.foot_geoms, 0] = physics["friction"]
    bodies, torso = index.robot_bodies, index.torso_body
    mass, inertia = pristine.body_mass[bodies], pristine.body_inertia[bodies]
    model.body_mass[bodies] = mass * physics["mass_scale"]
    model.body_inertia[bodies] = inertia * physics["mass_scale"]
    loaded = (model.body_mass[torso] + physics["payload"]) / model.body_mass[torso]
    model.body_mass[torso] *= loaded
    model.body_inertia[torso] *= loaded
    # torque = gain * target + bias . (1, q, q'), so kp is in both and kd in the bias
    gain, bias = pristine.actuator_gainprm, pristine.actuator_biasprm
    model.actuator_gainprm[:, 0] = gain[:, 0] * physics["stiffness_scale"]
    model.actuator_biasprm[:, 1] = bias[:, 1] * physics["stiffness_scale"]
    model.actuator_biasprm[:, 2] = bias[:, 2] * physics["damping_scale"]


def initial_offset(config: RandomisationConfig, scenario: Scenario) -> NDArray[np.float64]:
    """(J,) rad to add to the joints of waist and arms at the start; the legs stay planted."""
    offset = scenario.rng("initial").uniform(-1.0, 1.0, NUM_JOINTS) * config.initial_joint
    offset[:12] = 0.0
    return offset


def _scene(task: str, config: EnvConfig) -> Scene:
    return build_scene(find_task(task).scene_tasks(config), config.feet)


def settle(config: EnvConfig, controller: LowLevelController) -> StandingPose:
    """The pose in which episodes start: ``controller`` holds the neutral command for 2 s.

    The simulation is noiseless; the pelvis of the result is over the world's origin.

    Raises:
        EnvironmentFailure: the controller does not keep the robot standing.
    """
    scene = _scene(DEFAULT_TASK, config)
    robot = SimulatedRobot(scene)
    start = standing_pose(ACTION_BOX.neutral[-1])
    start.position[:2] = 0.0
    robot.reset(start)
    robot.forward()
    sensors = Proprioception(_NOISELESS, scene.index, np.random.default_rng(0))
    state = np.zeros((1, STATE_DIM))
    state[0, COMMAND_SLICE] = np.concatenate([np.zeros(3), ACTION_BOX.neutral])
    sensors.measure(robot.data, state[0])
    controller.reset(state)
    for _ in range(_SETTLE_TICKS):
        robot.data.ctrl[:] = controller.step(state)[0]
        for _ in range(PHYSICS_STEPS_PER_CONTROLLER_TICK):
            robot.step()
        sensors.measure(robot.data, state[0])
    if robot.diverged or robot.pelvis_height < _LEAST_HEIGHT:
        raise EnvironmentFailure(
            f"the controller {controller.id} does not stand: pelvis at "
            f"{robot.pelvis_height:.2f} m after 2 s, expected at least {_LEAST_HEIGHT} m; use it "
            "with the robot model that it was trained on"
        )
    q = robot.data.qpos.copy()
    return StandingPose(np.array([0.0, 0.0, q[2]]), q[3:7], q[scene.index.joint_qpos])


class EnvInstance(BaseInstance):
    """Simulates one robot in one episode at a time; all randomness comes from the scenario.

    A depth image of age k is rendered k controller ticks before the planner tick that observes it;
    one is rendered per planner tick. If ``render_depth`` is false, all of them are zero.
    """

    def __init__(
        self,
        config: EnvConfig,
        camera: RayCastCamera,
        standing: StandingPose,
        scenario: Scenario,
        render_depth: bool = True,
    ) -> None:
        self._config = config
        self._renders = render_depth
        self._camera = camera
        self._standing = standing
        self._robots: dict[str, SimulatedRobot] = {}
        self.start(scenario)

    def start(self, scenario: Scenario) -> None:
        """Begin the episode of ``scenario``."""
        self.scenario = scenario
        self.robot = self._robot(scenario.task)
        self._draw_sensors()
        self.physics = sample_physics(self._config.randomise, scenario)
        apply_physics(self.physics, self.robot.scene, self.robot.model)
        task: Any = find_task(scenario.task)(self._config, scenario, self.robot)
        self.task: Task = task
        self._caster = RayCaster(self.robot.model, self.robot.index.torso_body)
        offset = initial_offset(self._config.randomise, scenario)
        self.robot.reset(replace(self._standing, joints=self._standing.joints + offset))
        self.task.place()
        self.robot.forward()
        self.tick = 0
        self.terminated = self.truncated = False
        self._controller_tick = 0
        self.state = np.zeros(STATE_DIM)
        self._sensors.measure(self.robot.data, self.state)
        count = 1 + self.image_age // CONTROLLER_TICKS_PER_PLAN
        self._images = deque([self._next_image()] * count, maxlen=count)

    def _robot(self, task: str) -> SimulatedRobot:
        if task not in self._robots:
            self._robots[task] = SimulatedRobot(_scene(task, self._config))
        return self._robots[task]

    def _draw_sensors(self) -> None:
        config, scenario = self._config, self.scenario
        rng = scenario.rng("delay")
        low, high = config.delay.action_ticks
        self.action_delay = int(rng.integers(low, high + 1))
        self.image_age = round(float(rng.uniform(*config.delay.image_age)) * CONTROLLER_HZ)
        noise = scenario.rng("image")
        self.camera_pitch = float(noise.uniform(*config.camera.pitch_range))
        self._noise = DepthNoise(config.camera, noise)
        index = self.robot.index
        self._sensors = Proprioception(config.sensors, index, scenario.rng("proprioception"))

    @property
    def parameters(self) -> dict[str, float]:
        """As `BaseInstance.parameters`; SI units, delays in controller ticks."""
        return {
            **self.physics,
            **super().parameters,
            "action_delay_ticks": self.action_delay,
            "image_age_ticks": self.image_age,
            "camera_pitch": self.camera_pitch,
        }

    @property
    def metadata(self) -> dict[str, Any]:
        """What datasets record of the scenario."""
        return {
            "event_tick": self.task.event_tick,
            "action_delay_ticks": self.action_delay,
            "image_age_ticks": self.image_age,
            "camera_pitch": self.camera_pitch,
            "physics": self.physics,
            "scene": self.task.parameters,
        }

    def contacts(self) -> dict[str, bool]:
        """Whether the ``hands``, and whether ``other`` parts, touched the object in this tick."""
        touched = self.task.forces > 0
        hands = touched[list(HANDS)]
        return {"hands": bool(hands.any()), "other": bool(touched.sum() > hands.sum())}

    @property
    def base_pose(self) -> Array:
        """(7,) pose of the pelvis in the world, m and quaternion wxyz."""
        pose: Array = self.robot.data.qpos[:7].copy()
        return pose

    @property
    def depth(self) -> NDArray[np.uint16]:
        """(H, W) mm: the image in the observation of this planner tick."""
        return self._images[-1 - self.image_age // CONTROLLER_TICKS_PER_PLAN]

    def advance(self, target: Array) -> None:
        """One controller tick: physics under the joint targets (J,), then the sensors."""
        if self.done:
            return
        self.robot.data.ctrl[:] = target
        for _ in range(PHYSICS_STEPS_PER_CONTROLLER_TICK):
            self.step()

    def step(self) -> None:
        """One physics step under the current motor commands; the sensors after every fourth.

        Raises:
            SimulationDiverged: as `require_valid_physics`.
        """
        if self.task.physics_steps % PHYSICS_STEPS_PER_TICK == 0:
            self.task.begin_tick()
        self.task.step()
        if self.task.physics_steps % PHYSICS_STEPS_PER_CONTROLLER_TICK == 0:
            self._controller_tick += 1
            self.require_valid_physics()
            self._sense()

    def require_valid_physics(self) -> None:
        """Raise `SimulationDiverged` if the physics is no longer that of a real robot."""
        if not self.robot.diverged:
            return
        scenario = self.scenario
        scene = ", ".join(f"{name}={value:.3g}" for name, value in self.task.parameters.items())
        raise SimulationDiverged(
            f"the simulation diverged in task {scenario.task}, seed {scenario.seed}, episode "
            f"{scenario.episode}, after {self.task.time:.2f} s: {self.robot.divergence}; the scene "
            f"is {scene}; choose narrower ranges of --env.{self.task.current_name} or "
            "--env.randomise"
        )

    def _sense(self) -> None:
        self.robot.refresh_poses()
        self._sensors.measure(self.robot.data, self.state)
        if (self._controller_tick + self.image_age) % CONTROLLER_TICKS_PER_PLAN == 0:
            self._images.append(self._next_image())

    def _next_image(self) -> NDArray[np.uint16]:
        return self.render() if self._renders else _NO_IMAGE

    def render(self) -> NDArray[np.uint16]:
        """(H, W) mm: a depth image of the current body poses, with the camera's noise."""
        depth = self._camera.render(self._caster, self.robot.data, self.camera_pitch)
        return self._noise.apply(depth)
