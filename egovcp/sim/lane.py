"""One row of the vectorised environment: a robot, its episode, its sensors and delays."""

from __future__ import annotations

from collections import deque
from dataclasses import asdict
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import SimulationDiverged
from egovcp.sim.camera import DepthCamera, DepthNoise
from egovcp.sim.config import EnvConfig
from egovcp.sim.randomise import apply_physics, draw_physics, initial_offset
from egovcp.sim.rays import View
from egovcp.sim.robot import SimulatedRobot
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import build_scene
from egovcp.sim.sensors import Proprioception
from egovcp.sim.standing import Standing
from egovcp.sim.tasks import make_task
from egovcp.sim.tasks.base import PHYSICS_STEPS_PER_TICK
from egovcp.spec import (
    CONTROLLER_HZ,
    CONTROLLER_TICKS_PER_PLAN,
    DEPTH_COLS,
    DEPTH_ROWS,
    PHYSICS_STEPS_PER_CONTROLLER_TICK,
    STATE_DIM,
)

Array = NDArray[np.float64]

_EMPTY: Final = np.zeros((DEPTH_ROWS, DEPTH_COLS), dtype=np.uint16)


class Lane:
    """Runs one episode. Everything random in it comes from the scenario.

    A picture of age k controller ticks is taken k controller ticks before the planner tick
    that sees it; one picture is rendered per planner tick, whatever its age. Without
    ``pictures`` all of them are empty; nothing else changes.
    """

    def __init__(
        self,
        config: EnvConfig,
        camera: DepthCamera,
        standing: Standing,
        scenario: Scenario,
        pictures: bool = True,
    ) -> None:
        self._config = config
        self._sees = pictures
        self._camera = camera
        self._standing = standing
        self._robots: dict[str, SimulatedRobot] = {}
        self.start(scenario)

    def start(self, scenario: Scenario) -> None:
        """Begin the episode of ``scenario``."""
        self.scenario = scenario
        self.robot = self._robot(scenario.task)
        self._draw_sensors()
        self.physics = draw_physics(self._config.randomise, scenario)
        apply_physics(self.physics, self.robot.scene, self.robot.model)
        self.task = make_task(self._config, scenario, self.robot)
        self._drawn = self.task.parameters
        self._view = View(self.robot.model, self.robot.index.torso_body)
        offset = initial_offset(self._config.randomise, scenario)
        self.robot.reset(self._standing.joints + offset, self._standing.pelvis)
        self.task.place()
        self.robot.forward()
        self.tick = 0
        self.terminated = self.truncated = False
        self._controller_tick = 0
        self.state = np.zeros(STATE_DIM)
        self._sensors.measure(self.robot.data, self.state)
        kept = 1 + self.image_age // CONTROLLER_TICKS_PER_PLAN
        self._pictures = deque([self._take_picture()] * kept, maxlen=kept)

    def _robot(self, task: str) -> SimulatedRobot:
        if task not in self._robots:
            self._robots[task] = SimulatedRobot(build_scene(task, self._config.feet))
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
        """What was drawn for this episode, for the record; SI units, delays in 20 ms ticks.

        ``event_tick`` is -1 in an episode without an event.
        """
        event = self.task.event_tick
        return {
            **asdict(self.physics),
            **self._drawn,
            "event_tick": -1 if event is None else event,
            "action_delay_ticks": self.action_delay,
            "image_age_ticks": self.image_age,
            "camera_pitch": self.camera_pitch,
        }

    @property
    def done(self) -> bool:
        """Whether the episode has ended; a lane that is done stands still."""
        return self.terminated or self.truncated

    @property
    def depth(self) -> NDArray[np.uint16]:
        """(H, W) mm: the picture that the present planner tick sees."""
        return self._pictures[-1 - self.image_age // CONTROLLER_TICKS_PER_PLAN]

    @property
    def camera_pose(self) -> tuple[Array, Array]:
        """Position (3,) and rotation (3, 3) of the camera now, world; x is the optical axis."""
        robot = self.robot
        return self._camera.pose(robot.data, robot.index.torso_body, self.camera_pitch)

    def advance(self, target: Array) -> None:
        """One controller tick: physics under the joint targets (J,), then the sensors."""
        if self.done:
            return
        self.robot.data.ctrl[:] = target
        for _ in range(PHYSICS_STEPS_PER_CONTROLLER_TICK):
            self.step()

    def step(self) -> None:
        """One physics step under what the motors were told; the sensors after every fourth.

        Raises:
            SimulationDiverged: see `require_valid_physics`.
        """
        if self.task.physics_steps % PHYSICS_STEPS_PER_TICK == 0:
            self.task.begin_tick()
        self.task.step()
        if self.task.physics_steps % PHYSICS_STEPS_PER_CONTROLLER_TICK == 0:
            self._controller_tick += 1
            self.require_valid_physics()
            self._sense()

    def require_valid_physics(self) -> None:
        """Check the simulation.

        Raises:
            SimulationDiverged: its numbers are not those of a real robot any more.
        """
        if not self.robot.diverged:
            return
        scenario = self.scenario
        drawn = ", ".join(f"{name}={value:.3g}" for name, value in self._drawn.items())
        error = SimulationDiverged(
            f"the simulation diverged in task {scenario.task}, seed {scenario.seed}, episode "
            f"{scenario.episode}, after {self.task.time:.2f} s: {self.robot.divergence}; the scene "
            f"is {drawn}; choose narrower ranges of --env.{self.task.present} or --env.randomise"
        )
        error.episode = scenario.episode
        raise error

    def _sense(self) -> None:
        self.robot.refresh_poses()
        self._sensors.measure(self.robot.data, self.state)
        if (self._controller_tick + self.image_age) % CONTROLLER_TICKS_PER_PLAN == 0:
            self._pictures.append(self._take_picture())

    def _take_picture(self) -> NDArray[np.uint16]:
        return self.look() if self._sees else _EMPTY

    def look(self) -> NDArray[np.uint16]:
        """(H, W) mm: a picture taken now, of body poses that are up to date."""
        depth = self._camera.render(self._view, self.robot.data, self.camera_pitch)
        return self._noise.apply(depth)

    def end_tick(self, action: Array) -> dict[str, float]:
        """Close the planner tick in which ``action`` (7,) was sent: reward terms and flags."""
        if self.done:
            return {}
        self.tick += 1
        terms = self.task.end_tick(action)
        self.terminated = self.task.fallen
        self.truncated = not self.terminated and self.task.is_over
        return terms
