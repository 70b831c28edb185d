"""One simulated robot: its MuJoCo model and data, contacts, divergence and proprioception."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.robot.stance_table import StandingPose
from egovcp.sim.config import SensorConfig
from egovcp.sim.scene import HEAD, TORSO, Contact, Scene, SceneIndex
from egovcp.spec import COMMAND_SLICE, STATE_DIM, STATE_SLICES

Array = NDArray[np.float64]

_ANGULAR_VELOCITY: Final = STATE_SLICES["angular_velocity"]
_GRAVITY: Final = STATE_SLICES["projected_gravity"]
_POSITION: Final = STATE_SLICES["joint_position"]
_VELOCITY: Final = STATE_SLICES["joint_velocity"]
#: MuJoCo warnings after which the physics is wrong: for the first three, MuJoCo has also reset the
#: state.
_WARNINGS: Final = {
    mujoco.mjtWarning.mjWARN_BADQACC: "acceleration of {dof} is not finite or huge",
    mujoco.mjtWarning.mjWARN_BADQVEL: "velocity of {dof} is not finite or huge",
    mujoco.mjtWarning.mjWARN_BADQPOS: "a position is not finite or huge",
    mujoco.mjtWarning.mjWARN_BADCTRL: "a joint target is not finite",
    mujoco.mjtWarning.mjWARN_INERTIA: "the inertia matrix is singular",
    mujoco.mjtWarning.mjWARN_CONTACTFULL: "there are too many contacts",
    mujoco.mjtWarning.mjWARN_CNSTRFULL: "there are too many constraints",
}
_WARNING_NUMBERS: Final = np.array([int(kind) for kind in _WARNINGS], dtype=np.intp)
MAX_SPEED: Final = 1000.0
"""Faster joints and bodies count as diverged, rad/s or m/s; the joints of the G1 reach 37 rad/s."""

_LYING_HEIGHT = 0.5  # m, pelvis; above it no part of the trunk reaches the floor


class SimulatedRobot:
    """Physics of one robot in one task's scene, with its own copy of the model to edit."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.index = scene.index
        self.model = copy.copy(scene.model)
        self.data = mujoco.MjData(self.model)
        self._wrench = np.zeros(6)

    def shape_geom(self, geom: int, size: Sequence[float], centre: Sequence[float]) -> None:
        """Give a sphere or box of an object another size (m) and place in its body's frame.

        Updates the bounds that the compiler derived from the size: contacts and rays rely on them.
        """
        model, body = self.model, self.model.geom_bodyid[geom]
        extent = np.resize(np.asarray(size, dtype=np.float64), 3)
        model.geom_size[geom, : len(size)] = size
        model.geom_pos[geom] = centre
        model.geom_aabb[geom, 3:] = extent
        model.geom_rbound[geom] = size[0] if len(size) == 1 else np.linalg.norm(extent)
        first = model.body_bvhadr[body]
        nodes = model.bvh_aabb[first : first + model.body_bvhnum[body]]
        # boxes around the body's centre of mass, in the axes of its inertia
        reach = np.linalg.norm(centre - model.body_ipos[body]) + np.linalg.norm(extent)
        nodes[:, 3:] = np.maximum(np.abs(nodes[:, :3]) + nodes[:, 3:], reach)
        nodes[:, :3] = 0.0

    def reset(self, pose: StandingPose) -> None:
        """Place the robot at rest in ``pose``."""
        mujoco.mj_setConst(self.model, self.data)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:3], self.data.qpos[3:7] = pose.position, pose.quaternion
        self.data.qpos[self.index.joint_qpos] = pose.joints

    def damp(self) -> None:
        """Make the servos damp only, until an episode's physics are applied again."""
        self.model.actuator_gainprm[:, 0] = 0.0
        self.model.actuator_biasprm[:, 1] = 0.0

    def forward(self) -> None:
        """Bring positions, contacts and velocities up to date with the state."""
        mujoco.mj_forward(self.model, self.data)

    def refresh_poses(self) -> None:
        """Bring body, geom and site poses up to date with the state."""
        mujoco.mj_kinematics(self.model, self.data)

    def step(self) -> list[Contact]:
        """One physics step; the contacts between robot and object that acted in it."""
        mujoco.mj_step(self.model, self.data)
        return self._contacts()

    def _contacts(self) -> list[Contact]:
        geoms = self.data.contact.geom
        of_object = self.index.is_object.take(geoms)
        if not of_object.any():
            return []
        found = []
        for i in np.flatnonzero(of_object.any(axis=1)):
            other = geoms[i, 1] if of_object[i, 0] else geoms[i, 0]
            part = int(self.index.part[other])
            if part >= 0:
                mujoco.mj_contactForce(self.model, self.data, int(i), self._wrench)
                found.append(Contact(part, float(self._wrench[0])))
        return found

    @property
    def diverged(self) -> bool:
        """Whether the physics has diverged since the last reset."""
        data = self.data
        if data.warning.number.take(_WARNING_NUMBERS).any():
            return True
        return not (np.abs(data.qvel).max() <= MAX_SPEED and math.isfinite(data.qpos.sum()))

    @property
    def divergence(self) -> str:
        """What diverged; empty if nothing has."""
        for kind, words in _WARNINGS.items():
            warning = self.data.warning[kind]
            if warning.number:
                named = "{dof}" in words
                dof = self._dof_name(int(warning.lastinfo)) if named else ""
                return f"{words.format(dof=dof)} ({kind.name})"
        for dof in np.flatnonzero(~(np.abs(self.data.qvel) <= MAX_SPEED)):
            return f"velocity of {self._dof_name(int(dof))} is {self.data.qvel[dof]:.3g} per second"
        return "" if math.isfinite(self.data.qpos.sum()) else "a position is not finite"

    def _dof_name(self, dof: int) -> str:
        """The joint of a degree of freedom, or the body if the joint has no name."""
        joint = int(self.model.dof_jntid[dof])
        name = self.model.joint(joint).name
        return str(name or self.model.body(int(self.model.jnt_bodyid[joint])).name)

    @property
    def pelvis_height(self) -> float:
        """m above ground."""
        return float(self.data.qpos[2])

    @property
    def rotation(self) -> Array:
        """(3, 3) from the pelvis frame to the world."""
        out = np.empty(9)
        mujoco.mju_quat2Mat(out, self.data.qpos[3:7])
        return out.reshape(3, 3)

    @property
    def tilt(self) -> float:
        """Angle between the pelvis' z axis and the vertical, rad."""
        return float(np.arccos(min(max(self.rotation[2, 2], -1.0), 1.0)))

    @property
    def heading(self) -> Array:
        """(3, 3) from the pelvis heading frame to the world: a rotation by yaw only."""
        forward = self.rotation[:2, 0]
        c, s = forward / max(float(np.hypot(*forward)), 1e-9)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    @property
    def palms_b(self) -> Array:
        """(2, 3) palm sites, left and right, m, pelvis heading frame."""
        palms = self.data.site_xpos[self.index.palm_sites] - self.data.qpos[:3]
        return np.asarray(palms @ self.heading)

    @property
    def on_floor(self) -> bool:
        """Whether torso, pelvis or head touches the floor."""
        if self.pelvis_height > _LYING_HEIGHT:
            return False
        geoms = self.data.contact.geom
        touching = geoms[(geoms == self.index.floor).any(axis=1)]
        return bool(np.isin(self.index.part[touching], (TORSO, HEAD)).any())


def noise_std(config: SensorConfig) -> Array:
    """(S,) standard deviation of each number of a measurement; 0 for the command."""
    out = np.zeros(STATE_DIM)
    out[_ANGULAR_VELOCITY] = config.angular_velocity
    out[_GRAVITY] = config.gravity
    out[_POSITION] = config.joint_position
    out[_VELOCITY] = config.joint_velocity
    return out


class Proprioception:
    """IMU and joint encoders of one robot in one episode."""

    def __init__(self, config: SensorConfig, index: SceneIndex, rng: np.random.Generator) -> None:
        self._index = index
        self._rng = rng
        self._std = noise_std(config)
        self._fresh = np.empty(STATE_DIM)
        self._rotation = np.empty(9)

    def measure(self, data: mujoco.MjData, out: Array) -> None:
        """Write a noisy measurement into ``out`` (S,), all but its command part."""
        fresh, qpos, qvel = self._fresh, data.qpos, data.qvel
        self._rng.standard_normal(out=fresh)
        fresh *= self._std
        fresh[_ANGULAR_VELOCITY] += qvel[3:6]
        mujoco.mju_quat2Mat(self._rotation, qpos[3:7])
        gravity = fresh[_GRAVITY]
        gravity -= self._rotation[6:]
        gravity /= np.sqrt(gravity @ gravity)
        fresh[_POSITION] += qpos[self._index.joint_qpos]
        fresh[_VELOCITY] += qvel[self._index.joint_qvel]
        out[: COMMAND_SLICE.start] = fresh[: COMMAND_SLICE.start]
        out[COMMAND_SLICE.stop :] = fresh[COMMAND_SLICE.stop :]
