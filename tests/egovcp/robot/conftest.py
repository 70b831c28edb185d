"""A robot on a floor, driven by a controller as the real one would be: noise and delay."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.robot.controllers import LowLevelController
from egovcp.robot.mjcf import FootModel, robot_spec
from egovcp.robot.stance import StanceController
from egovcp.robot.stance_table import standing_pose
from egovcp.spec import (
    ACTION_BOX,
    COMMAND_SLICE,
    PHYSICS_STEPS_PER_CONTROLLER_TICK,
    STATE_DIM,
    STATE_SLICES,
)

Array = NDArray[np.float64]
_NOISE = {
    "angular_velocity": 0.075,
    "projected_gravity": 0.015,
    "joint_position": 0.0075,
    "joint_velocity": 0.4,
}


def floor_model(feet: FootModel = "points") -> mujoco.MjModel:
    """The robot over a plane."""
    spec = robot_spec(feet)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(type=plane, size=[0, 0, 0.1], contype=1, conaffinity=1)
    return spec.compile()


@dataclass
class StandingRobot:
    """One simulated robot, its noise and one tick of delay."""

    controller: LowLevelController
    model: mujoco.MjModel
    noise: float = 1.0
    delay: int = 1
    height: float = 0.74
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def __post_init__(self) -> None:
        self.data = mujoco.MjData(self.model)
        pose = standing_pose(self.height)
        self.data.qpos[:] = np.concatenate([pose.position, pose.quaternion, pose.joints])
        mujoco.mj_forward(self.model, self.data)
        self.command = np.zeros(10)
        self.command[3:] = ACTION_BOX.to_metric(np.zeros(7))
        self.command[9] = self.height
        self.controller.reset(self.state())
        self.pending = deque([self.controller.step(self.state())[0]] * self.delay)

    def state(self) -> Array:
        """(1, S) what the robot measures."""
        s = np.zeros((1, STATE_DIM))
        s[0, COMMAND_SLICE] = self.command
        true_values = {
            "angular_velocity": self.data.qvel[3:6],
            "projected_gravity": -self.data.xmat[1].reshape(3, 3)[2],
            "joint_position": self.data.qpos[7:],
            "joint_velocity": self.data.qvel[6:],
        }
        for name, value in true_values.items():
            noise = self.noise * _NOISE[name] * self.rng.normal(size=value.shape)
            s[0, STATE_SLICES[name]] = value + noise
        return s

    def tick(self) -> None:
        """One controller tick, 20 ms."""
        self.pending.append(self.controller.step(self.state())[0])
        self.data.ctrl[:] = self.pending.popleft()
        mujoco.mj_step(self.model, self.data, PHYSICS_STEPS_PER_CONTROLLER_TICK)

    def run(self, seconds: float) -> None:
        """Tick for a while with the command as it is."""
        for _ in range(round(seconds * 50)):
            self.tick()

    @property
    def upright(self) -> bool:
        """Not fallen: pelvis above 0.35 m and tilted by less than 1 rad."""
        return bool(self.data.qpos[2] > 0.35 and self.data.xmat[1][8] > np.cos(1.0))

    def palms(self) -> Array:
        """(2, 3) true palm positions in the pelvis heading frame, m."""
        rotation = self.data.xmat[1].reshape(3, 3)
        yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
        c, s = np.cos(yaw), np.sin(yaw)
        heading = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        sites = [self.model.site(f"{side}_palm").id for side in ("left", "right")]
        return np.asarray((self.data.site_xpos[sites] - self.data.xpos[1]) @ heading)


@pytest.fixture(scope="session")
def floor_models() -> dict[FootModel, mujoco.MjModel]:
    """Both foot models on a floor; tests must not change them."""
    return {"points": floor_model("points"), "stock": floor_model("stock")}


@pytest.fixture
def standing(
    floor_models: dict[FootModel, mujoco.MjModel],
) -> Callable[..., StandingRobot]:
    """Makes a standing robot: ``standing("stock", height=0.6, noise=0.0)``."""

    def make(feet: FootModel = "points", **options: float) -> StandingRobot:
        return StandingRobot(StanceController(), floor_models[feet], **options)  # type: ignore[arg-type]

    return make
