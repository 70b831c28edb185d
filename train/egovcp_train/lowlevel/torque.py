"""Motor load of a controller: RMS torque, and torque beyond what gravity needs.

Winding losses grow with the square of the torque, so the RMS torque over time is a measure of
heating. Unitree publishes no continuous rating of the G1's motors, so torques are relative to the
peak torque (`egovcp.robot.g1.EFFORT_LIMIT`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from egovcp.robot.controllers import LowLevelController
from egovcp.robot.g1 import EFFORT_LIMIT
from egovcp.robot.mjcf import FootModel
from egovcp.sim.config import SensorConfig
from egovcp.sim.robot import noise_std
from egovcp.spec import CONTROLLER_HZ, JOINT_NAMES
from egovcp_train.lowlevel.config import DisturbanceConfig
from egovcp_train.lowlevel.physics import BatchPhysics, compile_model, neutral_qpos
from egovcp_train.lowlevel.sensing import measure
from egovcp_train.lowlevel.skills import neutral

Array = NDArray[np.float64]

STANDING_S: Final = 60.0
RELATIVE_MARGIN: Final = 0.2  # of the torque that gravity needs
#: Share of the peak torque that every joint may have in addition; joint friction is of this order.
ABSOLUTE_MARGIN: Final = 0.01
_CONE_EDGES: Final = 8  # of the pyramid that approximates a friction cone
_BALANCE_WEIGHT: Final = 1e3  # weight of the pelvis' six equations; torques have 1 / peak
_NOMINAL: Final = DisturbanceConfig(
    models=1,
    friction=(0.8, 0.8),
    payload=(0.0, 0.0),
    mass_scale=(1.0, 1.0),
    stiffness_scale=(1.0, 1.0),
    damping_scale=(1.0, 1.0),
    delay=(0.0, 0.0),
)
_NOISELESS: Final = SensorConfig(0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class StandingLoad:
    """Torque of each joint while standing at the neutral pose, (29,) N m, JOINT_NAMES order."""

    mean: Array
    """Mean torque over the second half of the time."""
    needed: Array
    """Static torque that holds the final pose with the least relative effort."""

    @property
    def excess(self) -> Array:
        """(29,) |mean| minus |needed| and both margins, share of the peak torque; at most 0: within
        the limit."""
        allowed = (1.0 + RELATIVE_MARGIN) * np.abs(self.needed) + ABSOLUTE_MARGIN * EFFORT_LIMIT
        return np.asarray((np.abs(self.mean) - allowed) / EFFORT_LIMIT)


def relative_rms(torque: Array, counted: NDArray[np.bool_]) -> Array:
    """RMS torque of each joint over the counted ticks, relative to the motor's peak.

    Args:
        torque: (T, N, 29) N m.
        counted: (T, N).

    Returns:
        (N, 29); not-a-number for a robot without counted ticks.
    """
    relative = np.nan_to_num(torque / EFFORT_LIMIT) ** 2
    number = counted.sum(axis=0)[:, None]
    total = np.where(counted[..., None], relative, 0.0).sum(axis=0)
    return np.where(number > 0, np.sqrt(total / np.maximum(number, 1)), np.nan)


def standing_load(
    controller: LowLevelController,
    feet: FootModel = "stock",
    seconds: float = STANDING_S,
) -> StandingLoad:
    """Let the nominal robot stand at the neutral pose and compare its torques with gravity's need.

    Args:
        controller: for one robot.
        feet: foot collision model.
        seconds: how long to stand.
    """
    physics = BatchPhysics(1, feet, _NOMINAL, threads=1, seed=0)
    rng, std = np.random.default_rng(0), noise_std(_NOISELESS)
    qpos = neutral_qpos(1)
    physics.place(np.arange(1), qpos, qpos[:, 7:])
    commands = neutral(round(seconds * CONTROLLER_HZ), 1, rng)
    no_delay = np.zeros(1, np.intp)
    x = physics.snapshot()
    controller.reset(measure(x, commands[0], std, rng))
    torques = []
    for command in commands:
        physics.step(controller.step(measure(x, command, std, rng)), no_delay)
        x = physics.snapshot()
        torques.append(x.torque[0].copy())
    final = physics.qpos[0].copy()
    physics.close()
    mean = np.mean(torques[len(torques) // 2 :], axis=0)
    return StandingLoad(mean, static_torque(compile_model(feet), final))


def static_torque(model: mujoco.MjModel, qpos: Array) -> Array:
    """Joint torques that hold ``qpos`` (36,) at rest against gravity, with the least effort.

    With contact Jacobian J and gravity's generalised force g, a robot at rest satisfies

        g = S^T tau + J^T f,    f in the friction cones

    Standing on two feet leaves internal forces free. Among all solutions this takes the one with
    the least sum of (tau / peak)^2: a non-negative least-squares problem in the edges of the
    linearised cones.

    Returns:
        (29,) N m.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    edges = _cone_edges(model, data)  # (nv, m)
    weight = np.concatenate([np.full(6, _BALANCE_WEIGHT), 1.0 / EFFORT_LIMIT])
    gravity = data.qfrc_bias
    share, _ = nnls(weight[:, None] * edges, weight * gravity)
    return np.asarray((gravity - edges @ share)[6:])


def _cone_edges(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """(nv, m) generalised force of a unit normal force along each edge of each contact's cone."""
    edges = []
    for contact in data.contact:
        body = model.geom_bodyid[contact.geom].max()  # the floor belongs to the world, body 0
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jacobian, None, contact.pos, body)
        for angle in 2.0 * np.pi * np.arange(_CONE_EDGES) / _CONE_EDGES:
            slope = contact.friction[0]
            force = np.array([slope * np.cos(angle), slope * np.sin(angle), 1.0])
            edges.append(jacobian.T @ force)
    return np.array(edges).reshape(-1, model.nv).T


def describe(load: StandingLoad) -> str:
    """One line about the joint with the largest excess."""
    joint = int(np.argmax(load.excess))
    verdict = "within the limit" if load.excess[joint] <= 0.0 else "EXCEEDED"
    return (
        f"standing load: {JOINT_NAMES[joint]} {abs(load.mean[joint]):.2f} N m, gravity needs "
        f"{abs(load.needed[joint]):.2f} N m; {load.excess[joint]:+.1%} of the peak torque against "
        f"the limit (need + {RELATIVE_MARGIN:.0%} + {ABSOLUTE_MARGIN:.0%} of peak): {verdict}"
    )
