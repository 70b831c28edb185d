"""Brace against the wall: pushed at a wall, stay up and touch it with the hands only."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final

import mujoco
import numpy as np

from egovcp.bounds import bounded
from egovcp.sim.scene import HANDS, Contact
from egovcp.sim.tasks.base import PARKED, Array, Task
from egovcp.sim.tasks.options import MAX_REWARD, EpisodeConfig, Range, TaskConfig
from egovcp.spec import PHYSICS_DT

if TYPE_CHECKING:
    from egovcp.sim.config import EnvConfig
    from egovcp.sim.robot import SimulatedRobot
    from egovcp.sim.scenario import Scenario

WALL: Final = "wall"
_HALF_SIZE: Final = (0.05, 1.5, 1.3)  # m: half the thickness, width and height
# The oracle.
_PRESS: Final = 0.05  # m, hand targets behind the wall's surface
_PRESS_ASIDE: Final = 0.20  # m, left and right
_PRESS_HEIGHT: Final = 0.10  # m, above the pelvis


@dataclass(frozen=True)
class WallConfig(TaskConfig):
    """A wall in front of the robot; the robot is pushed towards it, and only the hands may touch
    it."""

    distance_range: Range = bounded((0.60, 0.70), least=0.3, most=10)
    """Distance from pelvis to wall surface, m."""
    yaw_range: Range = bounded((-0.10, 0.10), least=-1, most=1)
    """Turn of the wall about the vertical, rad; 0 faces the robot squarely."""
    friction_range: Range = bounded((0.6, 1.0), least=0, most=5)
    """Sliding friction of the wall."""
    push_speed_range: Range = bounded((0.70, 1.00), least=0, most=5)
    """Change of base velocity by a push towards the wall, m/s."""
    push_bearing_range: Range = bounded((-0.20, 0.20), least=-math.pi, most=math.pi)
    """Direction of a push towards the wall, rad from straight ahead."""
    away_probability: float = bounded(0.1, least=0, most=1)
    """Share of the pushes that go away from the wall."""
    away_speed_range: Range = bounded((0.05, 0.15), least=0, most=5)
    """Change of base velocity by a push away from the wall, m/s; a robot that holds its pose
    stays up."""
    push_time: float = bounded(0.02, least=0.005, most=1)
    """Time over which a push acts, s."""
    disturbed_time: float = bounded(1.0, least=0, most=3600)
    """Time after a push during which the wall task is active, s."""
    hit_cost: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, when anything but a hand touches the wall."""


def add_wall(spec: mujoco.MjSpec) -> None:
    """Add a wall as a mocap body; its origin is on the surface, its x axis points into it."""
    body = spec.worldbody.add_body(name=WALL, mocap=True, pos=PARKED)
    centre, box = [_HALF_SIZE[0], 0, _HALF_SIZE[2]], mujoco.mjtGeom.mjGEOM_BOX
    size = list(_HALF_SIZE)
    body.add_geom(name=WALL, type=box, size=size, pos=centre, contype=1, conaffinity=0, priority=1)


class WallTask(Task):
    """One push, towards the wall or (sometimes) away from it, at the event."""

    name = WALL
    description = "brace with the hands on a wall when pushed towards it"
    terms: ClassVar = {"hit": "hit"}
    config: WallConfig = WallConfig()
    event = "robot pushed"
    short_episode = EpisodeConfig(ticks=100, event_ticks=(4, 30))
    in_sequence = "last"  # the robot leans on it
    constant_poses = ((0.4, 0.8, 1.0), (0.0, -0.3), (0.3, 0.55, 0.8), (0.0,))
    seed_key = 1

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> None:
        super().__init__(config, scenario, robot)
        c = self.config
        sampled = self.sample("distance", "yaw", "friction")
        push = scenario.rng("push")
        self.away = bool(push.random() < c.away_probability)
        self._bearing = float(push.uniform(*c.push_bearing_range)) + math.pi * self.away
        speed = c.away_speed_range if self.away else c.push_speed_range
        self.push_speed = float(push.uniform(*speed))
        self.parameters |= {"push_speed": self.push_speed, "push_bearing": self._bearing}
        self._hit = False
        self._body = robot.model.body(WALL)
        self._mocap = int(self._body.mocapid[0])
        robot.model.geom(WALL).friction[0] = sampled["friction"]

    @classmethod
    def add_objects(cls, spec: mujoco.MjSpec) -> None:
        add_wall(spec)

    def place(self) -> None:
        pelvis, heading = self.robot.data.qpos[:3], self.robot.heading
        self._surface = pelvis + heading @ np.array([self.parameters["distance"], 0.0, 0.0])
        self._surface[2] = 0.0
        wall_yaw = math.atan2(heading[1, 0], heading[0, 0]) + self.parameters["yaw"]
        data = self.robot.data
        quaternion = (math.cos(wall_yaw / 2), 0.0, 0.0, math.sin(wall_yaw / 2))
        data.mocap_pos[self._mocap], data.mocap_quat[self._mocap] = self._surface, quaternion
        self._normal = np.array([math.cos(wall_yaw), math.sin(wall_yaw), 0.0])

    def park(self) -> None:
        self.robot.data.mocap_pos[self._mocap] = self._body.pos

    def before_step(self) -> None:
        """Push: the base gains ``push_speed`` in equal parts over ``push_time``, in whole steps."""
        # half a step of slack keeps rounding from adding or losing one part
        since = self.since_event + PHYSICS_DT / 2
        duration = max(1, round(self.config.push_time / PHYSICS_DT)) * PHYSICS_DT
        if 0.0 <= since < duration:
            part = self.push_speed * PHYSICS_DT / duration
            direction = np.array([math.cos(self._bearing), math.sin(self._bearing), 0.0])
            self.robot.data.qvel[:3] += part * (self.robot.heading @ direction)

    def process_contacts(self, contacts: Sequence[Contact]) -> None:
        """Remember any contact that was not a hand's."""
        if any(contact.part not in HANDS for contact in contacts):
            self._hit = True

    @property
    def disturbed(self) -> bool:
        """Whether the push is recent."""
        return 0.0 <= self.since_event <= self.config.disturbed_time

    def rewards(self) -> dict[str, float]:
        return {"hit": -self.config.hit_cost * self.once("hit", self._hit)}

    @property
    def achieved(self) -> bool:
        """Nothing but hands has touched the wall."""
        return not self._hit

    @property
    def object_w(self) -> Array:
        """(3,) where the pelvis' x axis meets the wall, m."""
        pelvis, forward = self.robot.data.qpos[:3], self.robot.heading[:, 0]
        gap = (self._surface - pelvis) @ self._normal / max(float(forward @ self._normal), 0.1)
        point: Array = pelvis + gap * forward
        return point

    def oracle(self) -> Array:
        """After a push towards the wall, press both hands on it."""
        if self.away or not self.disturbed:
            return np.zeros(7)
        ahead = self.object_b[0] + _PRESS
        left, right = (ahead, _PRESS_ASIDE, _PRESS_HEIGHT), (ahead, -_PRESS_ASIDE, _PRESS_HEIGHT)
        return self.action_of(left, right)
