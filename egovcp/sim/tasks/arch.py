"""Traverse the arch: duck under a lintel that an upright robot would hit.

With ``motion="walk"`` the robot walks to a fixed arch, and the velocity command steers it onto the
middle of the arch. With ``rail`` the robot stands and the arch moves towards it at the commanded
speed. The arch is kinematic: contacts do not move it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np

from egovcp.sim.config import ArchConfig, EnvConfig
from egovcp.sim.robot import Contact, SimulatedRobot
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import ARCH, ARCH_GEOMS, HEAD, PARTS
from egovcp.sim.tasks.base import Array, ObjectState, Solid, Task
from egovcp.spec import ACTION_HANDS, PHYSICS_DT

_OTHERS: Final = [part for part in range(len(PARTS)) if part != HEAD]
_POST_HALF_WIDTH: Final = 0.06  # m
_BEHIND: Final = 0.25  # m, an arch this far behind the pelvis has been passed
# Steering of a walking robot.
_SIDE_GAIN: Final = 0.5  # 1/s
_MOST_SIDEWAYS: Final = 0.1  # m/s
_TURN_GAIN: Final = 1.0  # 1/s
_MOST_TURNING: Final = 0.3  # rad/s


class ArchTask(Task):
    """One arch, which starts to move at the event."""

    config: ArchConfig
    terms: ClassVar = ("progress", "pass", "head", "contact", "crouch", "pose", "fall")

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> None:
        super().__init__(config, scenario, robot)
        self.config = config.arch
        names = ("clearance", "width", "depth", "distance", "lateral", "speed")
        sampled = self._sample(scenario, *names)
        self.clearance, self.speed = sampled["clearance"], sampled["speed"]
        self._half_width, self._half_depth = sampled["width"] / 2, sampled["depth"] / 2
        self._ahead = sampled["distance"]  # arch centre ahead of the pelvis now, m
        self._touched = False
        self._passed = False
        self._progress = 0.0  # m in this tick
        self._body = robot.model.body(ARCH)
        self._mocap = int(self._body.mocapid[0])
        self._shape_arch()

    @property
    def parameters(self) -> dict[str, float]:
        return self._parameters | {"distance": self._ahead}

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
        for name, (size, centre) in zip(ARCH_GEOMS, boxes, strict=True):
            self.robot.shape_geom(self.robot.model.geom(name).id, size, centre)

    def place(self) -> None:
        pelvis, heading = self.robot.data.qpos[:3], self.robot.heading
        self._direction, self._start = heading[:, 0].copy(), pelvis.copy()
        self._origin = pelvis + heading @ np.array([0.0, self._parameters["lateral"], 0.0])
        self._origin[2] = 0.0
        turn = math.atan2(heading[1, 0], heading[0, 0])
        quaternion = (math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2))
        self.robot.data.mocap_quat[self._mocap] = quaternion
        self._put()

    def _put(self) -> None:
        self.robot.data.mocap_pos[self._mocap] = self._origin + self._ahead * self._direction

    def park(self) -> None:
        self.robot.data.mocap_pos[self._mocap] = self._body.pos

    @property
    def moving(self) -> bool:
        """Whether the robot is commanded to walk, or the arch moves."""
        return self.since_event >= 0.0

    @property
    def velocity_command(self) -> Array:
        """(3,) see `Task`; forward, and back onto the course, from the event to the passage."""
        if not self.moving or (self._walks and self._passed):
            return np.zeros(3)
        if not self._walks:
            return np.array([self.speed, 0.0, 0.0])
        aside, turned = self._off_course()
        sideways = min(max(-_SIDE_GAIN * aside, -_MOST_SIDEWAYS), _MOST_SIDEWAYS)
        turning = min(max(-_TURN_GAIN * turned, -_MOST_TURNING), _MOST_TURNING)
        return np.array([self.speed, sideways, turning])

    @property
    def _walks(self) -> bool:
        return self.config.motion == "walk"

    def _off_course(self) -> tuple[float, float]:
        """Pelvis left of the course (m), and its heading relative to the course (rad)."""
        ahead, left = self._direction, np.array([-self._direction[1], self._direction[0], 0.0])
        aside = float((self.robot.data.qpos[:3] - self._start) @ left)
        forward = self.robot.heading[:, 0]
        return aside, math.atan2(float(forward @ left), float(forward @ ahead))

    def begin_tick(self) -> None:
        super().begin_tick()
        self._progress = 0.0

    def before_step(self) -> None:
        """Move the arch along the rail, or measure how far the robot has walked."""
        before = self._ahead
        if self._walks:
            arch = self.robot.data.mocap_pos[self._mocap]
            self._ahead = float((arch - self.robot.data.qpos[:3]) @ self._direction)
        elif self.moving:
            self._ahead -= self.speed * PHYSICS_DT
            self._put()
        if self.moving:
            self._progress += before - self._ahead

    def process_contacts(self, contacts: Sequence[Contact]) -> None:
        self._touched = self._touched or bool(contacts)

    def rewards(self, action: Array) -> dict[str, float]:
        c = self.config
        passes = not self._passed and self._ahead + self._half_depth < -_BEHIND
        under_way = self.moving and not self._passed
        self._passed = self._passed or passes
        needless = abs(self._ahead) > c.near or self._passed
        crouch = max(0.0, -float(action[6]))
        return {
            "progress": c.progress_reward * self._progress * under_way,
            "pass": c.pass_reward * (passes and not self._touched),
            "head": -c.head_cost * bool(self.forces[HEAD] > 0.0),
            "contact": -c.contact_cost * bool(self.forces[_OTHERS].any()),
            "crouch": -c.crouch_cost * crouch * needless,
            "pose": -c.pose_cost * float(np.mean(action[ACTION_HANDS] ** 2)),
        }

    @property
    def achieved(self) -> bool:
        """Passed without contact; in an empty episode, no contact."""
        return not self._touched and (self.event_tick is None or self._passed)

    @property
    def finished(self) -> bool:
        return self._passed

    def state(self) -> ObjectState:
        velocity = -self.speed * (self.moving and not self._walks) * self._direction
        position = self.robot.data.mocap_pos[self._mocap].copy()
        return ObjectState(position, velocity, self.clearance, self.moving and not self._passed)

    def solids(self) -> tuple[Solid, ...]:
        model, data = self.robot.model, self.robot.data
        found = []
        for name in ARCH_GEOMS:
            geom = model.geom(name).id
            size = tuple(float(s) for s in model.geom_size[geom])
            centre, turn = data.geom_xpos[geom].copy(), data.mocap_quat[self._mocap].copy()
            found.append(Solid(name, "box", (size[0], size[1], size[2]), centre, turn))
        return tuple(found)
