"""Block the ball: a thrown ball must meet a hand or wrist before the body.

The ball leaves s at the event and reaches the aim point p after the flight time T under
gravity g:  v0 = (p - s) / T - g T / 2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Final

import mujoco
import numpy as np

from egovcp.sim.config import BallConfig, EnvConfig
from egovcp.sim.robot import Contact, SimulatedRobot
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import BALL, HANDS, HEAD, LEG, TORSO
from egovcp.sim.tasks.base import Array, ObjectState, Solid, Task

_PARKED: Final = np.array([-20.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0])  # behind the robot, unseen
_AT_REST: Final = np.zeros(6)
_GRAVITY: Final = np.array([0.0, 0.0, -9.81])  # m/s^2
_HALF_EDGE: Final = (math.pi / 6) ** (1 / 3)  # of a cube, in radii of the ball of its volume
_TUMBLE: Final = 6.0  # rad/s, the most that a box turns about each axis


class BallTask(Task):
    """One throw at the upper body, at the event."""

    config: BallConfig
    terms: ClassVar = ("block", "hit", "pose", "fall")

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> None:
        super().__init__(config, scenario, robot)
        self.config = config.ball
        at_release = ("radius", "mass", "distance", "bearing", "release_height", "flight")
        sampled = self._sample(scenario, *at_release, "aim_lateral", "aim_height")
        self.radius, self.flight = sampled["radius"], sampled["flight"]
        aim = (self.config.aim_forward, sampled["aim_lateral"], sampled["aim_height"])
        self._aim_b = np.array(aim)
        self._turned, self._turning = self._attitude(scenario)
        self._thrown = False
        self._grounded = False  # on the floor: contacts no longer count
        self._blocked_at: float | None = None
        self.hit = False
        self._new_block = False
        self._new_hit = False
        self._shape_ball()

    def _attitude(self, scenario: Scenario) -> tuple[Array, Array]:
        """Quaternion and angular velocity (rad/s) at the release; constant for a ball."""
        if not self._is_box:
            return np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
        rng = scenario.rng("attitude")
        quaternion = rng.normal(size=4)
        return quaternion / np.linalg.norm(quaternion), rng.uniform(-_TUMBLE, _TUMBLE, 3)

    @property
    def _is_box(self) -> bool:
        return self.config.shape == "box"

    @property
    def _half_sizes(self) -> tuple[float, float, float]:
        """Half edges of a box, or the radius three times, m."""
        half = self.radius * _HALF_EDGE if self._is_box else self.radius
        return (half, half, half)

    def _shape_ball(self) -> None:
        model = self.robot.model
        body = model.body(BALL).id
        geom, size = int(model.body_geomadr[body]), self._half_sizes
        kinds = mujoco.mjtGeom
        model.geom_type[geom] = kinds.mjGEOM_BOX if self._is_box else kinds.mjGEOM_SPHERE
        self.robot.shape_geom(geom, size if self._is_box else size[:1], [0.0, 0.0, 0.0])
        model.body_mass[body] = self._parameters["mass"]
        share = 2 / 3 if self._is_box else 2 / 5
        model.body_inertia[body] = share * self._parameters["mass"] * size[0] ** 2

    def place(self) -> None:
        self.park()

    def park(self) -> None:
        self._set_ball(_PARKED, _AT_REST)

    def _set_ball(self, pose: Array, velocity: Array) -> None:
        self.robot.data.qpos[-7:] = pose
        self.robot.data.qvel[-6:] = velocity

    def before_step(self) -> None:
        """Keep the ball parked until the event, then throw it."""
        if self._thrown:
            return
        if self.since_event < 0:
            self.park()
            return
        self._thrown = True
        start, velocity = self._throw()
        self._set_ball(np.append(start, self._turned), np.append(velocity, self._turning))

    def _throw(self) -> tuple[Array, Array]:
        """Release point and velocity, world, aimed at the robot as it stands now."""
        pelvis, heading = self.robot.data.qpos[:3], self.robot.heading
        aim = pelvis + heading @ self._aim_b
        bearing = self._parameters["bearing"]
        away = np.array([math.cos(bearing), math.sin(bearing), 0.0])
        start = pelvis + heading @ away * self._parameters["distance"]
        start[2] = self._parameters["release_height"]
        return start, (aim - start) / self.flight - 0.5 * _GRAVITY * self.flight

    def process_contacts(self, contacts: Sequence[Contact]) -> None:
        """Detect the first block and the first hit."""
        if not self._thrown or self._grounded:
            return
        parts = {contact.part for contact in contacts}
        if not self.blocked and not self.hit and parts & set(HANDS):
            self._blocked_at = self.time
            self._new_block = True
        elif not self._in_grace and not self.hit and parts & {TORSO, HEAD, LEG}:
            self.hit = self._new_hit = True
        self._grounded = bool(self.robot.data.qpos[-5] < self.radius + 0.01)

    @property
    def blocked(self) -> bool:
        """Whether a hand or wrist was the first to touch the ball."""
        return self._blocked_at is not None

    @property
    def _in_grace(self) -> bool:
        """Whether contacts do not count, shortly after a block."""
        return self._blocked_at is not None and self.time - self._blocked_at < self.config.grace

    def rewards(self, action: Array) -> dict[str, float]:
        block, self._new_block = self._new_block, False
        hit, self._new_hit = self._new_hit, False
        return {
            "block": self.config.block_reward * block,
            "hit": -self.config.hit_cost * hit,
            "pose": -self.config.pose_cost * float(np.mean(action**2)),
        }

    @property
    def achieved(self) -> bool:
        """Blocked by a hand and not hit elsewhere; in an empty episode, always."""
        return not self.hit and (self.event_tick is None or self.blocked)

    @property
    def finished(self) -> bool:
        return self._grounded

    def state(self) -> ObjectState:
        data = self.robot.data
        over = self._grounded or self.hit or self.blocked
        if not self._thrown:
            nothing = np.full(3, np.nan)
            return ObjectState(nothing, nothing.copy(), self.radius, active=False)
        return ObjectState(
            data.qpos[-7:-4].copy(), data.qvel[-6:-3].copy(), self.radius, active=not over
        )

    def solids(self) -> tuple[Solid, ...]:
        if not self._thrown:
            return ()
        pose = self.robot.data.qpos[-7:].copy()
        return (Solid(BALL, self.config.shape, self._half_sizes, pose[:3], pose[3:]),)
