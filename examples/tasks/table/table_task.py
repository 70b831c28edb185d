"""Brace on a table: pushed over the edge of a table, land on its top with both hands.

The table is as high as the hips. A push throws the robot towards the edge, which would hit its
thighs; the hands on the top have to stop it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from egovcp.sim.tasks import (
    HANDS,
    Array,
    Contact,
    EpisodeConfig,
    Range,
    Task,
    TaskConfig,
    bounded,
)

HALF = (0.35, 0.70, 0.02)  # m: depth, width, thickness of the top
PUSH_TIME = 0.02  # s


@dataclass(frozen=True)
class TableConfig(TaskConfig):
    """A table in front of the robot; the robot is pushed towards its edge, and only the hands may
    touch it."""

    distance_range: Range = bounded((0.32, 0.40), least=0.2, most=5)
    """Edge of the table before the pelvis, m."""
    height_range: Range = bounded((0.66, 0.70), least=0.3, most=1.2)
    """Upper side of the table above ground, m."""
    yaw_range: Range = bounded((-0.1, 0.1), least=-1, most=1)
    """Turn of the table about the vertical, rad; 0 faces the robot squarely."""
    speed_range: Range = bounded((0.65, 0.85), least=0, most=5)
    """Change of base velocity by the push, m/s."""
    bearing_range: Range = bounded((-0.15, 0.15), least=-math.pi, most=math.pi)
    """Direction of the push, rad from straight ahead."""
    brace_reward: float = bounded(1.0, least=0, most=1000)
    """Once, when both hands have touched the table after the push and nothing else has."""
    hit_cost: float = bounded(1.0, least=0, most=1000)
    """Once, when anything but a hand touches the table."""


class TableTask(Task):
    """One push over the edge, at the event."""

    name = "table"
    description = "brace with both hands on a table when pushed over its edge"
    event = "robot pushed"
    terms = {"brace": "block", "hit": "hit"}
    config: TableConfig = TableConfig()
    episode = EpisodeConfig(ticks=125, event_ticks=(10, 40))
    short_episode = EpisodeConfig(ticks=75, event_ticks=(4, 20))
    event_duration_ticks = 30

    def __init__(self, config, scenario, robot) -> None:
        super().__init__(config, scenario, robot)
        self.sample("distance", "height", "yaw", "speed", "bearing")
        self._mocap = int(robot.model.body(self.name).mocapid[0])
        self._hands: set[int] = set()
        self._hit = False

    @classmethod
    def add_objects(cls, spec: mujoco.MjSpec) -> None:
        body = spec.worldbody.add_body(name=cls.name, mocap=True, pos=[20, 0, 0])
        place, box = [HALF[0], 0, -HALF[2]], mujoco.mjtGeom.mjGEOM_BOX
        body.add_geom(
            name=cls.name, type=box, size=list(HALF), pos=place, contype=1, conaffinity=0,
            priority=1, friction=[1.0, 0.005, 0.0001],
        )  # fmt: skip

    def place(self) -> None:
        """The body's origin is the middle of the upper edge, its x axis points away."""
        data, heading, drawn = self.robot.data, self.robot.heading, self.parameters
        self._edge = data.qpos[:3] + heading @ np.array([drawn["distance"], 0.0, 0.0])
        self._edge[2] = drawn["height"]
        turn = math.atan2(heading[1, 0], heading[0, 0]) + drawn["yaw"]
        self._away = np.array([math.cos(turn), math.sin(turn), 0.0])
        data.mocap_pos[self._mocap] = self._edge
        data.mocap_quat[self._mocap] = (math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2))

    def before_step(self) -> None:
        step_s, _ = self.physics_clock()
        if 0.0 <= self.since_event + step_s / 2 < PUSH_TIME:  # half a step of slack for rounding
            bearing = self.parameters["bearing"]
            part = self.parameters["speed"] * step_s / PUSH_TIME
            direction = np.array([math.cos(bearing), math.sin(bearing), 0.0])
            self.robot.data.qvel[:3] += part * (self.robot.heading @ direction)

    def process_contacts(self, contacts: Sequence[Contact]) -> None:
        parts = {contact.part for contact in contacts}
        self._hit = self._hit or bool(parts - set(HANDS))
        if self.since_event >= 0.0:
            self._hands |= parts & set(HANDS)

    @property
    def _braced(self) -> bool:
        return len(self._hands) == len(HANDS) and not self._hit

    def rewards(self) -> dict[str, float]:
        return {
            "brace": self.config.brace_reward * self.once("brace", self._braced),
            "hit": -self.config.hit_cost * self.once("hit", self._hit),
        }

    @property
    def achieved(self) -> bool:
        """Both hands on the table and nothing else; in an empty episode, nothing touched it."""
        return not self._hit and (self._braced or self.event_tick is None)

    @property
    def object_w(self) -> Array:
        """The middle of the edge."""
        edge: Array = self._edge.copy()
        return edge

    def oracle(self) -> Array:
        """After the push, press both hands on the top behind the edge."""
        if not 0.0 <= self.since_event < 1.5:
            return np.zeros(7)
        aside = np.array([-self._away[1], self._away[0], 0.0])
        place = self._edge + 0.12 * self._away - self.robot.data.qpos[:3] - [0.0, 0.0, 0.06]
        left, right = place + 0.2 * aside, place - 0.2 * aside
        return self.action_of(self.to_heading_frame(left), self.to_heading_frame(right))
