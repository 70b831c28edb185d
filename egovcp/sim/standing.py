"""The posture in which episodes start: what the controller settles into by itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import EnvironmentFailure
from egovcp.robot.arms import REST
from egovcp.robot.controller import LowLevelController
from egovcp.robot.g1 import ARMS
from egovcp.robot.stance_table import NU, stance_table
from egovcp.sim.config import SensorConfig
from egovcp.sim.robot import SimulatedRobot
from egovcp.sim.scene import Scene
from egovcp.sim.sensors import Proprioception
from egovcp.spec import (
    ACTION_BOX,
    COMMAND_SLICE,
    NUM_JOINTS,
    PHYSICS_STEPS_PER_CONTROLLER_TICK,
    STATE_DIM,
)

Array = NDArray[np.float64]

_SETTLE_TICKS: Final = 100  # controller ticks, 2 s
_SILENT: Final = SensorConfig(0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Standing:
    """A pose at rest, with the pelvis over the world's origin."""

    pelvis: Array
    """(7,) position m, quaternion wxyz."""
    joints: Array
    """(J,) rad."""


def design_pose() -> Standing:
    """The pose that the stance was designed around, at the neutral height."""
    height = ACTION_BOX.neutral[-1]
    row = stance_table().at(np.array([height]))
    joints = np.zeros(NUM_JOINTS)
    joints[:NU] = row.joints[0]
    joints[ARMS] = REST.ravel()
    pitch = row.pelvis[0, 2]
    pelvis = np.array([0.0, 0.0, height, np.cos(pitch / 2), 0.0, np.sin(pitch / 2), 0.0])
    return Standing(pelvis, joints)


def settle(scene: Scene, controller: LowLevelController) -> Standing:
    """Let ``controller`` hold the neutral command for 2 s, without noise.

    Raises:
        EnvironmentFailure: the controller does not keep the robot standing.
    """
    robot = SimulatedRobot(scene)
    start = design_pose()
    robot.reset(start.joints, start.pelvis)
    robot.forward()
    sensors = Proprioception(_SILENT, scene.index, np.random.default_rng(0))
    state = np.zeros((1, STATE_DIM))
    state[0, COMMAND_SLICE] = np.concatenate([np.zeros(3), ACTION_BOX.neutral])
    sensors.measure(robot.data, state[0])
    controller.reset(state)
    for _ in range(_SETTLE_TICKS):
        robot.data.ctrl[:] = controller.step(state)[0]
        for _ in range(PHYSICS_STEPS_PER_CONTROLLER_TICK):
            robot.step()
        sensors.measure(robot.data, state[0])
    if robot.diverged or robot.pelvis_height < 0.6:
        raise EnvironmentFailure(
            f"the controller {controller.id} does not stand: pelvis at "
            f"{robot.pelvis_height:.2f} m after 2 s, expected {ACTION_BOX.neutral[-1]} m; "
            "it was made for another robot model"
        )
    pelvis = robot.data.qpos[:7].copy()
    pelvis[:2] = 0.0
    return Standing(pelvis, robot.data.qpos[scene.index.joint_qpos].copy())
