"""Block the ball: a thrown ball must meet a hand or wrist before the body.

The ball leaves s at the event and reaches the aim point p after the flight time T under
gravity g:  v0 = (p - s) / T - g T / 2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Literal

import mujoco
import numpy as np

from egovcp.bounds import bounded
from egovcp.sim.scene import HANDS, HEAD, LEG, TORSO, Contact
from egovcp.sim.tasks.base import Array, Task
from egovcp.sim.tasks.options import MAX_REWARD, EpisodeConfig, Range, TaskConfig
from egovcp.spec import Solid

if TYPE_CHECKING:
    from egovcp.sim.config import EnvConfig
    from egovcp.sim.robot import SimulatedRobot
    from egovcp.sim.scenario import Scenario

BALL: Final = "ball"
_PARKED: Final = np.array([-20.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0])  # behind the robot, unseen
_AT_REST: Final = np.zeros(6)
_GRAVITY: Final = np.array([0.0, 0.0, -9.81])  # m/s^2
_HALF_EDGE: Final = (math.pi / 6) ** (1 / 3)  # of a cube with the volume of a ball of radius 1
_TUMBLE: Final = 6.0  # rad/s, the most that a box turns about each axis
# The oracle.
_LOOKAHEAD: Final = np.arange(0.0, 1.2, 0.01)  # s
_BLOCK_AHEAD: Final = 0.32  # m, distance from pelvis to the blocking hand
_HAND_OFFSET: Final = (0.03, 0.0, 0.0)  # m, middle of the hand capsule from the palm site


@dataclass(frozen=True)
class BallConfig(TaskConfig):
    """A ball thrown at the upper body; a first contact with hand or wrist blocks it."""

    shape: Literal["sphere", "box"] = "sphere"
    """Shape: a ball, or a tumbling cube of the same volume."""
    radius_range: Range = bounded((0.09, 0.12), least=0.01, most=0.3)
    """Radius of the ball, m."""
    mass_range: Range = bounded((0.15, 0.35), least=0.001, most=10)
    """Mass of the ball, kg."""
    distance_range: Range = bounded((2.5, 3.5), least=0.6, most=10)
    """Horizontal distance of the release point from the pelvis, m."""
    bearing_range: Range = bounded((-0.30, 0.30), least=-math.pi, most=math.pi)
    """Direction of the release point seen from the pelvis, rad, 0 is straight ahead."""
    release_height_range: Range = bounded((0.7, 1.4), least=0.1, most=5)
    """Height of the release point above ground, m."""
    flight_range: Range = bounded((0.65, 0.95), least=0.2, most=5)
    """Time from release to the aim point, s."""
    aim_forward: float = bounded(0.10, least=-1, most=1)
    """Aim point in front of the pelvis, m, heading frame."""
    aim_lateral_range: Range = bounded((-0.40, 0.40), least=-2, most=2)
    """Aim point left of the pelvis, m, heading frame."""
    aim_height_range: Range = bounded((0.10, 0.50), least=-1, most=2)
    """Aim point above the pelvis, m."""
    grace: float = bounded(0.3, least=0, most=60)
    """Contacts within this time after a block do not count, s."""
    block_reward: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, at a first contact with a hand or wrist."""
    hit_cost: float = bounded(1.0, least=0, most=MAX_REWARD)
    """Once, when the ball touches torso, head or leg."""


class BallTask(Task):
    """One throw at the upper body, at the event."""

    name = BALL
    description = "block a thrown ball with hand or wrist before it meets the body"
    terms: ClassVar = {"block": "block", "hit": "hit"}
    config: BallConfig = BallConfig()
    event = "ball thrown"
    short_episode = EpisodeConfig(ticks=60, event_ticks=(4, 20))
    event_duration_ticks = 25
    in_sequence = "anywhere"
    constant_poses = ((0.2, 0.45, 0.8), (0.0, -0.3, -0.6), (0.35, 0.6, 0.85), (0.0,))
    seed_key = 0

    def __init__(self, config: EnvConfig, scenario: Scenario, robot: SimulatedRobot) -> None:
        super().__init__(config, scenario, robot)
        at_release = ("radius", "mass", "distance", "bearing", "release_height", "flight")
        sampled = self.sample(*at_release, "aim_lateral", "aim_height")
        self.radius, self.flight = sampled["radius"], sampled["flight"]
        aim = (self.config.aim_forward, sampled["aim_lateral"], sampled["aim_height"])
        self._aim_b = np.array(aim)
        rotation = self._release_rotation(scenario)
        self._release_orientation, self._release_angular_velocity = rotation
        self._thrown = False
        self._grounded = False  # on the floor: contacts no longer count
        self._blocked_at: float | None = None
        self.hit = False
        joint = robot.model.body(BALL).jntadr[0]
        first, velocity = robot.model.jnt_qposadr[joint], robot.model.jnt_dofadr[joint]
        self._qpos, self._qvel = slice(first, first + 7), slice(velocity, velocity + 6)
        self._shape_ball()

    @classmethod
    def add_objects(cls, spec: mujoco.MjSpec) -> None:
        body = spec.worldbody.add_body(name=BALL, pos=[-20, 0, 1])
        body.add_freejoint()
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        body.add_geom(name=BALL, type=sphere, size=[0.1, 0, 0], mass=0.25, contype=1, conaffinity=1)

    def _release_rotation(self, scenario: Scenario) -> tuple[Array, Array]:
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
        """Half extents along its own axes, m."""
        half = self.radius * _HALF_EDGE if self._is_box else self.radius
        return (half, half, half)

    def _shape_ball(self) -> None:
        model = self.robot.model
        body = model.body(BALL).id
        geom, size = int(model.body_geomadr[body]), self._half_sizes
        kinds = mujoco.mjtGeom
        model.geom_type[geom] = kinds.mjGEOM_BOX if self._is_box else kinds.mjGEOM_SPHERE
        self.robot.shape_geom(geom, size if self._is_box else size[:1], [0.0, 0.0, 0.0])
        model.body_mass[body] = self.parameters["mass"]
        share = 2 / 3 if self._is_box else 2 / 5
        model.body_inertia[body] = share * self.parameters["mass"] * size[0] ** 2

    def place(self) -> None:
        self.park()

    def park(self) -> None:
        self._set_ball(_PARKED, _AT_REST)

    def _set_ball(self, pose: Array, velocity: Array) -> None:
        self.robot.data.qpos[self._qpos] = pose
        self.robot.data.qvel[self._qvel] = velocity

    def before_step(self) -> None:
        """Keep the ball parked until the event, then throw it."""
        if self._thrown:
            return
        if self.since_event < 0:
            self.park()
            return
        self._thrown = True
        start, velocity = self._throw()
        self._set_ball(
            np.append(start, self._release_orientation),
            np.append(velocity, self._release_angular_velocity),
        )

    def _throw(self) -> tuple[Array, Array]:
        """Release point and velocity, world, aimed at the robot as it stands now."""
        pelvis, heading = self.robot.data.qpos[:3], self.robot.heading
        aim = pelvis + heading @ self._aim_b
        bearing = self.parameters["bearing"]
        away = np.array([math.cos(bearing), math.sin(bearing), 0.0])
        start = pelvis + heading @ away * self.parameters["distance"]
        start[2] = self.parameters["release_height"]
        return start, (aim - start) / self.flight - 0.5 * _GRAVITY * self.flight

    def process_contacts(self, contacts: Sequence[Contact]) -> None:
        """Detect the first block and the first hit."""
        if not self._thrown or self._grounded:
            return
        parts = {contact.part for contact in contacts}
        if not self.blocked and not self.hit and parts & set(HANDS):
            self._blocked_at = self.time
        elif not self._in_grace and not self.hit and parts & {TORSO, HEAD, LEG}:
            self.hit = True
        self._grounded = bool(self._pose[2] < self.radius + 0.01)

    @property
    def _pose(self) -> Array:
        """(7,) position m and quaternion of the ball, world."""
        pose: Array = self.robot.data.qpos[self._qpos].copy()
        return pose

    @property
    def blocked(self) -> bool:
        """Whether a hand or wrist was the first to touch the ball."""
        return self._blocked_at is not None

    @property
    def _in_grace(self) -> bool:
        """Whether contacts do not count, shortly after a block."""
        return self._blocked_at is not None and self.time - self._blocked_at < self.config.grace

    def rewards(self) -> dict[str, float]:
        return {
            "block": self.config.block_reward * self.once("block", self.blocked),
            "hit": -self.config.hit_cost * self.once("hit", self.hit),
        }

    @property
    def achieved(self) -> bool:
        """Blocked by a hand and not hit elsewhere; in an empty episode, always."""
        return not self.hit and (self.event_tick is None or self.blocked)

    @property
    def finished(self) -> bool:
        return self._grounded

    @property
    def object_w(self) -> Array:
        """(3,) centre of the ball, m."""
        return self._pose[:3] if self._thrown else np.full(3, np.nan)

    def oracle(self) -> Array:
        """Put the nearer hand where the ball will cross a plane ahead of the body."""
        if not self._thrown or self._grounded or self.hit or self.blocked:
            return np.zeros(7)
        t = _LOOKAHEAD[:, None]
        velocity = self.to_heading_frame(self.robot.data.qvel[self._qvel][:3])
        path = self.object_b + velocity * t + 0.5 * _GRAVITY * t * t
        point = path[np.argmin(np.abs(path[:, 0] - _BLOCK_AHEAD))]
        target = point - _HAND_OFFSET
        return self.action_of(left=target) if point[1] > 0 else self.action_of(right=target)

    def solids(self) -> tuple[Solid, ...]:
        if not self._thrown:
            return ()
        pose = self._pose
        return (Solid(BALL, self.config.shape, self._half_sizes, pose[:3], pose[3:]),)
