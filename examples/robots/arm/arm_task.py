"""Reach below a ball that appears above the table, and keep the tip of the arm there."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from arm_robot import HEIGHT, PlanarArm, inverse_kinematics

from egovcp.sim.tasks import (
    Array,
    EpisodeConfig,
    Range,
    RobotTask,
    TaskConfig,
    bounded,
)

RADIUS = 0.05  # m
BALL_ABOVE_ARM = 0.10  # m, height of the ball above the plane of the arm
HIDDEN_POSITION = (0.0, 0.0, -1.0)  # m, below the table


@dataclass(frozen=True)
class ReachTaskConfig(TaskConfig):
    """A ball within the reach of the arm."""

    distance_range: Range = bounded((0.24, 0.42), least=0.05, most=1)
    """Of the ball from the base, m."""
    bearing_range: Range = bounded((-1.2, 1.2), least=-math.pi, most=math.pi)
    """Direction of the ball from the base, rad from straight ahead."""
    tolerance: float = bounded(0.06, above=0, most=1)
    """Horizontal distance of the tip from the ball that counts as reached, m."""
    near_reward: float = bounded(0.2, least=0, most=1000)
    """Per planner tick below the ball; it falls by a factor of e per `scale` of distance."""
    scale: float = bounded(0.1, above=0, most=10)
    """Distance over which the reward decays, m."""


class ReachTask(RobotTask):
    """The ball appears at the event; success is to be below it at the end."""

    robot_class = PlanarArm
    name = "arm_reach"
    description = "reach below a ball that appears above the table"
    event = "ball appears"
    terms = {"near": "pass"}  # reward term: its column in the dataset
    config: ReachTaskConfig = ReachTaskConfig()
    episode = EpisodeConfig(ticks=60, event_ticks=(2, 15))
    short_episode = EpisodeConfig(ticks=50, event_ticks=(0, 6), empty_probability=0.05)

    def __init__(self, config, scenario, robot) -> None:
        super().__init__(config, scenario, robot)
        where = self.sample("distance", "bearing")  # from distance_range and bearing_range
        x = where["distance"] * math.cos(where["bearing"])
        y = where["distance"] * math.sin(where["bearing"])
        self._goal = np.array([x, y, HEIGHT + BALL_ABOVE_ARM])
        self._shown = False
        self._angles = np.zeros(3)

    @classmethod
    def add_objects(cls, spec: mujoco.MjSpec) -> None:
        """The ball, which nothing touches."""
        ball = spec.worldbody.add_body(name="ball", mocap=True, pos=HIDDEN_POSITION)
        ball.add_geom(
            name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS, 0, 0], contype=0,
            conaffinity=0,
        )  # fmt: skip

    def place(self) -> None:
        """The ball is below the table until the event."""
        self.robot.data.mocap_pos[0] = HIDDEN_POSITION

    def before_step(self) -> None:
        if self.since_event >= 0 and not self._shown:
            self._shown = True
            self.robot.data.mocap_pos[0] = self._goal
            self._angles = inverse_kinematics(*self._goal[:2])

    @property
    def _distance(self) -> float:
        off = self.robot.tip - self._goal
        return float(np.linalg.norm(off[:2])) if self._shown else math.inf

    def rewards(self) -> dict[str, float]:
        return {"near": self.config.near_reward * math.exp(-self._distance / self.config.scale)}

    @property
    def achieved(self) -> bool:
        return self._distance < self.config.tolerance

    @property
    def object_w(self) -> Array:
        return self._goal if self._shown else np.full(3, np.nan)

    def oracle(self) -> Array:
        return np.clip(self.robot.spec.action_box.to_normalised(self._angles), -1.0, 1.0)
