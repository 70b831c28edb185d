"""Draws the physical parameters of an episode and writes them into a robot's model."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.sim.config import RandomisationConfig
from egovcp.sim.scenario import Scenario
from egovcp.sim.scene import Scene
from egovcp.spec import NUM_JOINTS


@dataclass(frozen=True)
class Physics:
    """The physical parameters of one episode."""

    friction: float
    """Sliding friction of the feet."""
    payload: float
    """kg on the torso."""
    mass_scale: float
    """Factor on every mass of the robot."""
    stiffness_scale: float
    """Factor on the servo stiffness."""
    damping_scale: float
    """Factor on the servo damping."""


def draw_physics(config: RandomisationConfig, scenario: Scenario) -> Physics:
    """The parameters of ``scenario``."""
    rng = scenario.rng("physics")
    return Physics(
        friction=float(rng.uniform(*config.friction)),
        payload=float(rng.uniform(*config.payload)),
        mass_scale=float(rng.uniform(*config.mass_scale)),
        stiffness_scale=float(rng.uniform(*config.stiffness_scale)),
        damping_scale=float(rng.uniform(*config.damping_scale)),
    )


def apply_physics(physics: Physics, scene: Scene, model: mujoco.MjModel) -> None:
    """Write ``physics`` into ``model``, starting from the pristine values of ``scene``."""
    pristine, index = scene.model, scene.index
    model.geom_friction[index.foot_geoms, 0] = physics.friction
    bodies, torso = index.robot_bodies, index.torso_body
    mass, inertia = pristine.body_mass[bodies], pristine.body_inertia[bodies]
    model.body_mass[bodies] = mass * physics.mass_scale
    model.body_inertia[bodies] = inertia * physics.mass_scale
    loaded = (model.body_mass[torso] + physics.payload) / model.body_mass[torso]
    model.body_mass[torso] *= loaded
    model.body_inertia[torso] *= loaded
    _scale_servos(physics, pristine, model)


def _scale_servos(physics: Physics, pristine: mujoco.MjModel, model: mujoco.MjModel) -> None:
    """Torque = gain * target + bias . (1, q, q'), so kp is in both and kd in the bias."""
    gain, bias = pristine.actuator_gainprm, pristine.actuator_biasprm
    model.actuator_gainprm[:, 0] = gain[:, 0] * physics.stiffness_scale
    model.actuator_biasprm[:, 1] = bias[:, 1] * physics.stiffness_scale
    model.actuator_biasprm[:, 2] = bias[:, 2] * physics.damping_scale


def initial_offset(config: RandomisationConfig, scenario: Scenario) -> NDArray[np.float64]:
    """(J,) rad to add to the joints of waist and arms at the start; the legs stay planted."""
    offset = scenario.rng("initial").uniform(-1.0, 1.0, NUM_JOINTS) * config.initial_joint
    offset[:12] = 0.0
    return offset
