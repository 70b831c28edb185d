"""Stop a heavy bag that hangs from the ceiling and swings at the robot.

The bag is held aside until the event. Released, it swings in a vertical plane through the aim
point, as a pendulum; the robot has to stop it with the hands before it meets the body.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from egovcp.sim.tasks import (
    HANDS,
    HEAD,
    LEG,
    TORSO,
    Array,
    Contact,
    EpisodeConfig,
    Range,
    Task,
    TaskConfig,
    bounded,
)

LENGTH = 1.6  # m, from the hook to the middle of the bag
RADIUS, HALF_LENGTH = 0.13, 0.22  # m, of the capsule


@dataclass(frozen=True)
class BagConfig(TaskConfig):
    """A heavy bag that swings at the upper body; the hands have to stop it."""

    mass_range: Range = bounded((2.0, 4.0), least=0.1, most=50)
    """Mass of the bag, kg."""
    bearing_range: Range = bounded((-0.5, 0.5), least=-math.pi, most=math.pi)
    """Direction from which it comes, rad from straight ahead."""
    angle_range: Range = bounded((0.65, 0.85), least=0, most=1.5)
    """Angle of the rope at the release, rad from the vertical."""
    aim_lateral_range: Range = bounded((-0.2, 0.2), least=-1, most=1)
    """Aim point left of the pelvis, m."""
    height_range: Range = bounded((0.25, 0.40), least=-1, most=1)
    """Middle of the bag above the pelvis at its lowest point, m."""
    aim_forward: float = bounded(0.10, least=-1, most=1)
    """Aim point in front of the pelvis, m."""
    rest: float = bounded(0.60, least=0, most=2)
    """Distance between the aim point and the place under the hook, m."""
    stop_reward: float = bounded(1.0, least=0, most=1000)
    """Once, when the bag moves away again after it has met a hand and not the body."""
    hit_cost: float = bounded(1.0, least=0, most=1000)
    """Once, when the bag touches torso, head or leg."""


class BagTask(Task):
    """One swing, at the event."""

    name = "bag"
    description = "stop a heavy hanging bag that swings at the body, with the hands"
    event = "bag released"
    terms = {"stop": "block", "hit": "hit"}
    config: BagConfig = BagConfig()
    episode = EpisodeConfig(ticks=125, event_ticks=(10, 40))
    short_episode = EpisodeConfig(ticks=75, event_ticks=(4, 20))
    event_duration_ticks = 30

    def __init__(self, config, scenario, robot) -> None:
        super().__init__(config, scenario, robot)
        drawn = self.sample("mass", "bearing", "angle", "aim_lateral", "height")
        body, hook = robot.model.body("bag"), robot.model.body("bag_hook")
        self._body, self._hook = body.id, int(hook.mocapid[0])
        joint = int(body.jntadr[0])
        self._qpos, self._qvel = robot.model.jnt_qposadr[joint], robot.model.jnt_dofadr[joint]
        pristine = robot.scene.model
        heavier = drawn["mass"] / pristine.body_mass[self._body]
        robot.model.body_mass[self._body] = drawn["mass"]
        robot.model.body_inertia[self._body] = heavier * pristine.body_inertia[self._body]
        self._caught = self._stopped = self._hit = False

    @classmethod
    def add_objects(cls, spec: mujoco.MjSpec) -> None:
        hook = spec.worldbody.add_body(name="bag_hook", mocap=True, pos=[20, 0, 3])
        bag = hook.add_body(name="bag", pos=[0, 0, -LENGTH])
        ball, capsule = mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtGeom.mjGEOM_CAPSULE
        bag.add_joint(type=ball, pos=[0, 0, LENGTH], damping=0.2)
        size = [RADIUS, HALF_LENGTH, 0]
        bag.add_geom(name="bag", type=capsule, size=size, mass=3.0, contype=1, conaffinity=0)

    def place(self) -> None:
        """Hang the bag up around the standing robot, and hold it aside."""
        data, heading, drawn = self.robot.data, self.robot.heading, self.parameters
        bearing, angle = drawn["bearing"], drawn["angle"]
        self._from = heading @ np.array([math.cos(bearing), math.sin(bearing), 0.0])
        aim = heading @ np.array([self.config.aim_forward, drawn["aim_lateral"], drawn["height"]])
        self._aim = data.qpos[:3] + aim
        data.mocap_pos[self._hook] = self._aim + self.config.rest * self._from + [0, 0, LENGTH]
        axis = np.cross([0.0, 0.0, -1.0], self._from)
        self._held = np.append(math.cos(angle / 2), math.sin(angle / 2) * axis)
        self._hold()

    def _hold(self) -> None:
        self.robot.data.qpos[self._qpos : self._qpos + 4] = self._held
        self.robot.data.qvel[self._qvel : self._qvel + 3] = 0.0

    def before_step(self) -> None:
        if self.since_event < 0.0:
            self._hold()

    def process_contacts(self, contacts: Sequence[Contact]) -> None:
        parts = {contact.part for contact in contacts}
        self._hit = self._hit or bool(parts & {TORSO, HEAD, LEG})
        self._caught = self._caught or bool(parts & set(HANDS))

    def rewards(self) -> dict[str, float]:
        velocity, kind = np.empty(6), mujoco.mjtObj.mjOBJ_BODY
        mujoco.mj_objectVelocity(self.robot.model, self.robot.data, kind, self._body, velocity, 0)
        leaves = bool(velocity[3:] @ self._from > 0.0)
        self._stopped = self._stopped or (self._caught and not self._hit and leaves)
        return {
            "stop": self.config.stop_reward * self.once("stop", self._stopped),
            "hit": -self.config.hit_cost * self.once("hit", self._hit),
        }

    @property
    def achieved(self) -> bool:
        """Stopped by the hands and never on the body; in an empty episode, always."""
        return not self._hit and (self._stopped or self.event_tick is None)

    @property
    def object_w(self) -> Array:
        place: Array = self.robot.data.xpos[self._body].copy()
        return place

    def oracle(self) -> Array:
        """Hold both hands into the plane of the swing, until the bag has lost its momentum."""
        if not 0.0 <= self.since_event < 2.0:
            return np.zeros(7)
        reach = 0.22 * self._from + [0.0, 0.0, 0.05]
        x, y, z = self.to_heading_frame(self._aim + reach - self.robot.data.qpos[:3])
        return self.action_of(left=(x, y + 0.07, z), right=(x, y - 0.07, z))
