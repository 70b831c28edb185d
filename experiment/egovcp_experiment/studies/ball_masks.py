"""The pixels of the ball in simulated depth images, from the simulator's state."""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.robot.geometry import focal_length, pixel_rays, rotation_matrix
from egovcp.sim.config import EnvConfig
from egovcp.sim.env import PrivilegedState, VectorEnv
from egovcp.spec import CONTROLLER_HZ, CONTROLLER_TICKS_PER_PLAN, DEPTH_COLS, DEPTH_ROWS

_TOLERANCE_M: Final = 0.15  # of a pixel's depth: several standard deviations of the noise at 3 m

type Array = NDArray[np.float64]


class BallMasks:
    """Finds the ball in the images of a group of robots.

    An image of age k was taken k controller ticks before the observation that holds it, so the
    poses of the last planner ticks are kept and interpolated.

    Args:
        config: of the simulation.
    """

    def __init__(self, config: EnvConfig) -> None:
        rays = pixel_rays(focal_length(config.camera.vertical_fov))
        self._rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        oldest = round(config.delay.image_age[1] * CONTROLLER_HZ)
        self._truths: deque[PrivilegedState] = deque(maxlen=2 + oldest // CONTROLLER_TICKS_PER_PLAN)

    def begin(self) -> None:
        """Start a new group of episodes."""
        self._truths.clear()

    def update(self, env: VectorEnv) -> None:
        """Store the poses at a planner tick; to be called once per tick, before `mask`."""
        self._truths.append(env.privileged_state())

    def mask(self, env: VectorEnv, row: int, depth: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """(48, 64) pixels of the image ``depth`` (48, 64) mm of one robot that show the ball,
        where nothing hides it; none before the throw and after the first contact."""
        truth = self._truths[-1]
        if not truth.object_active[row]:
            return np.zeros(depth.shape, np.bool_)
        age = int(env.parameters[row]["image_age_ticks"])
        surface = self._surface(row, age, float(truth.object_size[row]))
        found: NDArray[np.bool_] = np.abs(depth / 1e3 - surface) < _TOLERANCE_M
        return found & (depth > 0)

    def _surface(self, row: int, age: int, radius: float) -> Array:
        """(48, 64) planar depth of the ball in an image of ``age`` controller ticks, m; NaN beside
        it."""
        ball, camera = self._at(row, age)
        rotation = rotation_matrix(camera[3:] / np.linalg.norm(camera[3:]))
        centre = rotation.T @ (ball - camera[:3])
        along = self._rays @ centre
        squared = radius**2 - (centre @ centre - along**2)
        hit = (squared > 0) & (along > 0)
        reach = along - np.sqrt(np.where(hit, squared, 0.0))
        depth: Array = np.where(hit, reach * self._rays[:, 0], np.nan)
        return depth.reshape(DEPTH_ROWS, DEPTH_COLS)

    def _at(self, row: int, age: int) -> tuple[Array, Array]:
        """Ball (3,) and camera (7,), ``age`` controller ticks before the last planner tick."""
        whole, rest = divmod(age, CONTROLLER_TICKS_PER_PLAN)
        share = rest / CONTROLLER_TICKS_PER_PLAN
        last = len(self._truths) - 1
        after, before = (self._truths[max(0, last - whole - k)] for k in (0, 1))
        ball = (1 - share) * after.object_w[row] + share * before.object_w[row]
        return ball, (1 - share) * after.camera_w[row] + share * before.camera_w[row]
