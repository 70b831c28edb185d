"""Traverse the arch: duck under a lintel that an upright robot would hit.

The robot walks to the arch, and the velocity command steers it onto the middle of the arch. The
arch is kinematic: contacts do not move it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final

import mujoco
import numpy as np

from egovcp.bounds import bounded
from egovcp.sim.tasks.base import PARKED, Array, Task
from egovcp.sim.tasks.options import MAX_REWARD, EpisodeConfig, Range, TaskConfig
from egovcp.spec import ACTION_BOX

if TYPE_CHECKING:
    from egovcp.sim.config import EnvConfig
    from egovcp.sim.robot import SimulatedRobot
    from egovcp.sim.scenario import Scenario
    from egovcp.sim.scene import Contact

ARCH: Final = "arch"
_GEOMS: Final = ("arch_left_post", "arch_right_post", "arch_lintel")
_POST_HALF_WIDTH: Final = 0.06  # m
_BEHIND: Final = 0.25  # m, an arch this far behind the pelvis has been passed
# Steering of a walking robot.
_SIDE_GAIN: Final = 0.5  # 1/s
_MOST_SIDEWAYS: Final = 0.1  # m/s
_TURN_GAIN: Final = 1.0  # 1/s
_MOST_TURNING: Final = 0.3  # rad/s
# The oracle.
_DUCK_FROM: Final = 0.75  # m, arch ahead of the pelvis
_DUCK_UNTIL: Final = -0.30  # m
_DUCK_BELOW: Final = 0.61  # m, of the pelvis below the lintel


@dataclass(frozen=True)
class ArchConfig(TaskConfig):
    """An arch that an upright robot would hit and a crouched one passes under."""

    clearance_range: Range = bounded((1.16, 1.24), least=0.5, most=3)
    """Lower edge of the lintel above ground, m."""
    width_range: Range = bounded((1.1, 1.5), least=0.4, most=10)
    """Free width between the posts, m."""
    depth_range: Range = bounded((0.10, 0.20), least=0.01, most=5)
    """Thickness of posts and lintel along the direction of passage, m."""
    lintel_height: float = bounded(0.35, least=0.01, most=5)
    """Height of the lintel beam, m."""
    distance_range: Range = bounded((1.6, 2.2), least=0.4, most=20)
    """Centre of the arch before the pelvis at the start, m."""
    lateral_range: Range = bounded((-0.08, 0.08), least=-5, most=5)
    """Centre of the arch left of the pelvis, m."""
    speed_range: Range = bounded((0.3, 0.5), least=0.01, most=2)
    """Commanded forward velocity, m/s."""
    pass_reward: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, when the arch has been passed without any contact."""
    hit_cost: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, when any part of the robot touches the arch."""


class ArchTask(Task):
    """One arch, which the robot starts to walk to at the event."""

    name = ARCH
    description = "walk up to an arch that is too low for an upright robot, and duck under it"
    terms: ClassVar = {"pass": "pass", "hit": "hit"}
    config: ArchConfig = ArchConfig()
    event = "passage begins"
    episode = EpisodeConfig(ticks=230, event_ticks=(5, 25))  # covers the slowest passage
    event_duration_ticks = 175
    needs_walking = True
    in_sequence = "anywhere"
    constant_poses = ((0.0,), (0.0,), (0.0,), (0.0, -0.2, -0.4, -0.6, -0.8, -1.0))
    seed_key = 2

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> None:
        super().__init__(config, scenario, robot)
        sampled = self.sample("clearance", "width", "depth", "distance", "lateral", "speed")
        self.clearance, self.speed = sampled["clearance"], sampled["speed"]
        self._half_width, self._half_depth = sampled["width"] / 2, sampled["depth"] / 2
        self._ahead = sampled["distance"]  # arch centre ahead of the pelvis now, m
        self._touched = False
        self._passed = False
        self._body = robot.model.body(ARCH)
        self._mocap = int(self._body.mocapid[0])
        self._shape_arch()

    @classmethod
    def add_objects(cls, spec: mujoco.MjSpec) -> None:
        body = spec.worldbody.add_body(name=ARCH, mocap=True, pos=PARKED)
        for name in _GEOMS:
            box = mujoco.mjtGeom.mjGEOM_BOX
            body.add_geom(name=name, type=box, size=[0.1, 0.1, 0.1], contype=1, conaffinity=0)

    def _shape_arch(self) -> None:
        """Write the sizes of posts and lintel; the arch's origin is its centre on the ground."""
        post_half = (self.clearance + self.config.lintel_height) / 2
        aside = self._half_width + _POST_HALF_WIDTH
        post = (self._half_depth, _POST_HALF_WIDTH, post_half)
        lintel = (self._half_depth, self._half_width, self.config.lintel_height / 2)
        above = self.clearance + lintel[2]
        boxes = (
            (post, (0.0, aside, post_half)),
            (post, (0.0, -aside, post_half)),
            (lintel, (0.0, 0.0, above)),
        )
        for name, (size, centre) in zip(_GEOMS, boxes, strict=True):
            self.robot.shape_geom(self.robot.model.geom(name).id, size, centre)

    def place(self) -> None:
        data, heading = self.robot.data, self.robot.heading
        self._direction, self._start = heading[:, 0].copy(), data.qpos[:3].copy()
        centre = self._start + heading @ np.array([self._ahead, self.parameters["lateral"], 0.0])
        turn = math.atan2(heading[1, 0], heading[0, 0])
        data.mocap_pos[self._mocap] = [centre[0], centre[1], 0.0]
        data.mocap_quat[self._mocap] = (math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2))

    def park(self) -> None:
        self.robot.data.mocap_pos[self._mocap] = self._body.pos

    @property
    def under_way(self) -> bool:
        """Whether the robot is commanded to walk: from the event to the passage."""
        return self.since_event >= 0.0 and not self._passed

    @property
    def velocity_command(self) -> Array:
        """(3,) see `Task`; forward, and back onto the course, while `under_way`."""
        if not self.under_way:
            return np.zeros(3)
        aside, turned = self._off_course()
        sideways = min(max(-_SIDE_GAIN * aside, -_MOST_SIDEWAYS), _MOST_SIDEWAYS)
        turning = min(max(-_TURN_GAIN * turned, -_MOST_TURNING), _MOST_TURNING)
        return np.array([self.speed, sideways, turning])

    def _off_course(self) -> tuple[float, float]:
        """Pelvis left of the course (m), and its heading relative to the course (rad)."""
        ahead, left = self._direction, np.array([-self._direction[1], self._direction[0], 0.0])
        aside = float((self.robot.data.qpos[:3] - self._start) @ left)
        forward = self.robot.heading[:, 0]
        return aside, math.atan2(float(forward @ left), float(forward @ ahead))

    def before_step(self) -> None:
        """Measure how far the arch is ahead."""
        arch = self.robot.data.mocap_pos[self._mocap]
        self._ahead = float((arch - self.robot.data.qpos[:3]) @ self._direction)

    def process_contacts(self, contacts: Sequence[Contact]) -> None:
        self._touched = self._touched or bool(contacts)

    def rewards(self) -> dict[str, float]:
        c = self.config
        self._passed = self._passed or self._ahead + self._half_depth < -_BEHIND
        return {
            "pass": c.pass_reward * self.once("pass", self._passed and not self._touched),
            "hit": -c.hit_cost * self.once("hit", self._touched),
        }

    @property
    def achieved(self) -> bool:
        """Passed without contact; in an empty episode, no contact."""
        return not self._touched and (self.event_tick is None or self._passed)

    @property
    def finished(self) -> bool:
        return self._passed

    @property
    def object_w(self) -> Array:
        """(3,) the middle of the lintel's lower edge, m."""
        edge: Array = self.robot.data.mocap_pos[self._mocap] + [0.0, 0.0, self.clearance]
        return edge

    def oracle(self) -> Array:
        """Squat as deep as the clearance requires while the arch is near."""
        if not self.under_way or not _DUCK_UNTIL < self.object_b[0] < _DUCK_FROM:
            return np.zeros(7)
        return self.action_of(height=max(self.clearance - _DUCK_BELOW, ACTION_BOX.low[-1]))
