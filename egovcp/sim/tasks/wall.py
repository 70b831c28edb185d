"""Brace against the wall: pushed at a wall, stay up and contact it with the hands only."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Final

import numpy as np

from egovcp.sim.config import EnvConfig, WallConfig
from egovcp.sim.robot import Contact, SimulatedRobot
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import HANDS, PARTS, WALL, WALL_HALF_SIZE
from egovcp.sim.tasks.base import Array, ObjectState, Solid, Task
from egovcp.spec import PHYSICS_DT

_HANDS: Final = list(HANDS)
_OTHERS: Final = [part for part in range(len(PARTS)) if part not in HANDS]
_BRACE_FORCE: Final = 5.0  # N, a hand that presses less only brushes the wall


class WallTask(Task):
    """One push, towards the wall or (sometimes) away from it, at the event."""

    config: WallConfig
    terms: ClassVar = ("brace", "upright", "contact", "impact", "pose", "guard", "fall")

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> None:
        super().__init__(config, scenario, robot)
        self.config = config.wall
        c = self.config
        sampled = self._sample(scenario, "distance", "yaw", "friction")
        push = scenario.rng("push")
        self.away = bool(push.random() < c.away_probability)
        self._bearing = float(push.uniform(*c.push_bearing_range)) + math.pi * self.away
        towards, disturbed = c.push_speed_range, c.disturbed_time
        assert towards is not None, "call `EnvConfig.for_controller` first"
        assert disturbed is not None, "call `EnvConfig.for_controller` first"
        self._disturbed_time = disturbed
        speed = c.away_speed_range if self.away else towards
        self.push_speed = float(push.uniform(*speed))
        sampled |= {"push_speed": self.push_speed, "push_bearing": self._bearing}
        self._touched_otherwise = False
        self._body = robot.model.body(WALL)
        self._mocap = int(self._body.mocapid[0])
        robot.model.geom(WALL).friction[0] = sampled["friction"]

    def place(self) -> None:
        pelvis, heading = self.robot.data.qpos[:3], self.robot.heading
        self._surface = pelvis + heading @ np.array([self._parameters["distance"], 0.0, 0.0])
        self._surface[2] = 0.0
        turn = math.atan2(heading[1, 0], heading[0, 0]) + self._parameters["yaw"]
        data, quaternion = self.robot.data, (math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2))
        data.mocap_pos[self._mocap], data.mocap_quat[self._mocap] = self._surface, quaternion
        self._normal = np.array([math.cos(turn), math.sin(turn), 0.0])

    def park(self) -> None:
        self.robot.data.mocap_pos[self._mocap] = self._body.pos

    def before_step(self) -> None:
        """Push: the base gains ``push_speed`` in equal parts over ``push_time``."""
        # half a step of slack keeps rounding from adding or losing one part
        since = self.since_event + PHYSICS_DT / 2
        if 0.0 <= since < self.config.push_time:
            part = self.push_speed * PHYSICS_DT / self.config.push_time
            direction = np.array([math.cos(self._bearing), math.sin(self._bearing), 0.0])
            self.robot.data.qvel[:3] += part * (self.robot.heading @ direction)

    def process_contacts(self, contacts: Sequence[Contact]) -> None:
        """Remember any contact that was not a hand's."""
        if any(contact.part not in HANDS for contact in contacts):
            self._touched_otherwise = True

    @property
    def disturbed(self) -> bool:
        """Whether the last push is recent enough for bracing to be rewarded."""
        return 0.0 <= self.since_event <= self._disturbed_time

    def rewards(self, action: Array) -> dict[str, float]:
        c = self.config
        hand_force = float(self.forces[_HANDS].max())
        upright = math.cos(self.robot.tilt) if self.disturbed else 0.0
        pose = float(np.mean(action**2))
        leaning = bool(self.forces[_OTHERS].any())
        braced = hand_force > _BRACE_FORCE and not leaning and not self.away
        return {
            "brace": c.brace_reward * upright * braced,
            "upright": c.upright_reward * upright,
            "contact": -c.contact_cost * leaning,
            "impact": -c.impact_cost * min(1.0, hand_force / c.impact_force),
            "pose": -c.pose_cost * pose,
            "guard": -c.guard_cost * pose if self.since_event < 0.0 else 0.0,
        }

    @property
    def achieved(self) -> bool:
        """Nothing but hands has touched the wall."""
        return not self._touched_otherwise

    def state(self) -> ObjectState:
        """Where the pelvis' x axis meets the wall; active while disturbed towards it."""
        pelvis, forward = self.robot.data.qpos[:3], self.robot.heading[:, 0]
        gap = (self._surface - pelvis) @ self._normal / max(float(forward @ self._normal), 0.1)
        point = pelvis + gap * forward
        return ObjectState(point, np.zeros(3), math.nan, self.disturbed and not self.away)

    def solids(self) -> tuple[Solid, ...]:
        centre = self._surface + WALL_HALF_SIZE[0] * self._normal
        centre[2] = WALL_HALF_SIZE[2]
        quaternion = self.robot.data.mocap_quat[self._mocap].copy()
        return (Solid(WALL, "box", WALL_HALF_SIZE, centre, quaternion),)
