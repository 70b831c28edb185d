"""Base class of simulated robots of another kind than the G1: a MuJoCo model and its sensors.

    class PlanarArm(MujocoRobot):
        spec = RobotSpec(...)                 # names, sizes, rate, action box
        control_id = "planar-arm-servo-1"

        @classmethod
        def build(cls): ...                   # robot, floor, servos, a camera named "depth"
        def state(self): ...                  # proprioception (S,)

By default the physical values of an action are the targets of the actuators, in their order; a
robot with another controller overrides `command`, one with sensor noise `state` and `depth`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure
from egovcp.robot.geometry import focal_length, pixel_rays
from egovcp.robot_spec import RobotSpec

Array = NDArray[np.float64]

_WARNINGS: Final = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)
_UPRIGHT: Final = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


class MujocoRobot(ABC):
    """One simulated robot in a scene.

    Args:
        model: of robot and task, made by `compile`; this robot's own copy.
    """

    spec: ClassVar[RobotSpec]
    """Observations and actions."""
    control_id: ClassVar[str]
    """Names model and control of the robot; data and policies of different ones are not mixed, so
    change it with them."""
    camera: ClassVar[str] = "depth"
    """Camera of the model that takes the depth images; its field of view is vertical."""
    depth_min_m: ClassVar[float] = 0.0
    """Nearer surfaces are 0 (invalid) in depth images, m."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.rng = np.random.default_rng(0)
        """Source of sensor noise in this episode."""
        cameras = [model.camera(i).name for i in range(model.ncam)]
        if self.camera not in cameras:
            raise EnvironmentFailure(
                f"robot {type(self).__name__}: its model has no camera {self.camera!r} (found: "
                f"{', '.join(cameras) or 'none'}); set the name in build or the attribute camera"
            )
        self._camera = cameras.index(self.camera)
        rows, columns = self.spec.depth
        focal = focal_length(math.radians(float(model.cam_fovy[self._camera])), rows)
        forward, left, up = pixel_rays(focal, rows, columns).T
        rays = np.stack([-left, up, -forward], axis=-1)  # MuJoCo's axes: x right, y up, -z forward
        self._rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)

    # --- the robot -----------------------------------------------------------------------
    @classmethod
    @abstractmethod
    def build(cls) -> mujoco.MjSpec:
        """A new scene with the robot, its actuators and its camera."""

    @abstractmethod
    def state(self) -> Array:
        """(S,) proprioception, in the order of ``spec.state_names``."""

    def reset(self, rng: np.random.Generator) -> None:
        """Go to the start pose of an episode: by default that of the model, at rest."""
        self.rng = rng
        mujoco.mj_resetData(self.model, self.data)

    def command(self, target: Array) -> None:
        """Follow ``target`` (A,), the physical values of an action, for a planner tick."""
        self.data.ctrl[:] = target

    def damp(self) -> None:
        """Switch the actuators off until the next episode, except for their damping."""
        self.model.actuator_gainprm[:] = 0.0
        self.model.actuator_biasprm[:, :2] = 0.0

    def depth(self) -> NDArray[np.uint16]:
        """(H, W) planar depth of the camera now, mm; 0 outside its range."""
        position = self.data.cam_xpos[self._camera]
        rotation = self.data.cam_xmat[self._camera].reshape(3, 3)
        rays, count = self._rays @ rotation.T, len(self._rays)
        geom, found = np.empty(count, np.int32), np.empty(count)
        own = int(self.model.cam_bodyid[self._camera]) or -1  # of a camera in the world: none
        mujoco.mj_multiRay(
            self.model, self.data, position, rays.ravel(), None, True, own, geom, found, None,
            count, math.inf,
        )  # fmt: skip
        planar = found * -self._rays[:, 2]  # a camera looks along -z
        seen = (found >= 0) & (planar >= self.depth_min_m) & (planar <= self.spec.depth_max_m)
        return (
            np.where(seen, 1000.0 * planar, 0.0).round().astype(np.uint16).reshape(self.spec.depth)
        )

    @property
    def base_pose(self) -> Array:
        """(7,) pose of the base frame in the world, position m and quaternion wxyz."""
        return np.array(_UPRIGHT)

    # --- the simulation ------------------------------------------------------------------
    @classmethod
    def physics_clock(cls, timestep: float) -> int:
        """Physics steps per planner tick.

        Raises:
            EnvironmentFailure: the tick is no whole number of them.
        """
        steps = 1.0 / (cls.spec.planner_hz * timestep)
        if abs(steps - round(steps)) > 1e-6:
            raise EnvironmentFailure(
                f"robot {cls.__name__}: a timestep of {timestep} s does not divide its planner "
                f"tick of 1 / {cls.spec.planner_hz} s; change the timestep of the model"
            )
        return round(steps)

    def step(self) -> None:
        """One physics step."""
        mujoco.mj_step(self.model, self.data)

    def forward(self) -> None:
        """Compute poses after the state was set."""
        mujoco.mj_forward(self.model, self.data)

    @property
    def diverged(self) -> bool:
        """Whether the physics is no longer valid."""
        return any(self.data.warning[kind].number for kind in _WARNINGS)
