"""The G1 as a MuJoCo spec: servos, contact parameters and a choice of foot model."""

from __future__ import annotations

from typing import Final, Literal

import mujoco

from egovcp.robot.g1 import ARMATURE, DAMPING, EFFORT_LIMIT, STIFFNESS, model_path
from egovcp.spec import JOINT_NAMES, PHYSICS_DT

FootModel = Literal["stock", "points"]

FOOT_FRICTION: Final = 0.8  # rubber on a laboratory floor; mjlab uses 0.6
_POINT_RADIUS: Final = 0.01  # m, the radius of the stock capsules
#: Corners of the foot (m, ankle-roll frame), inside the outline of the stock capsules.
_FOOT_CORNERS: Final = (
    (0.115, 0.024, -0.025),
    (0.115, -0.024, -0.025),
    (-0.046, 0.018, -0.025),
    (-0.046, -0.018, -0.025),
)


def robot_spec(feet: FootModel = "stock") -> mujoco.MjSpec:
    """G1 with position servos, ready to be set on a floor; no floor, light or task.

    Args:
        feet: ``stock``: seven capsules per foot as shipped; ``points``: four spheres per
            foot, about twice as fast to step.

    Actuator ``i`` drives ``spec.JOINT_NAMES[i]`` and has its name. Robot geoms have contype 0 and
    conaffinity 1: they collide with scene geoms of contype 1, not with each other. The foot geoms
    (priority 1) determine the friction of their contacts.
    """
    spec = mujoco.MjSpec.from_file(str(model_path()))
    spec.option.timestep = PHYSICS_DT
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    _add_servos(spec)
    for geom in _collision_geoms(spec):
        geom.contype, geom.conaffinity, geom.condim = 0, 1, 3
    if feet == "points":
        _replace_feet(spec)
    for geom in _foot_geoms(spec):
        geom.priority = 1
        geom.friction = [FOOT_FRICTION, 0.005, 0.0001]
    return spec


def _add_servos(spec: mujoco.MjSpec) -> None:
    """Torque = kp (target - q) - kd qdot, clipped to the effort limit; rotor inertia."""
    for i, name in enumerate(JOINT_NAMES):
        spec.joint(name).armature = float(ARMATURE[i])
        limit = float(EFFORT_LIMIT[i])
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=float(STIFFNESS[i]), kv=float(DAMPING[i]))
        servo.forcelimited = 1
        servo.forcerange = [-limit, limit]
        servo.ctrllimited = 0


def _collision_geoms(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    return [geom for geom in spec.geoms if geom.name.endswith("_collision")]


def _foot_geoms(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    return [geom for geom in _collision_geoms(spec) if "_foot" in geom.name]


def _replace_feet(spec: mujoco.MjSpec) -> None:
    """Four spheres per foot instead of seven capsules; names ``left_foot1_collision``.."""
    for geom in _foot_geoms(spec):
        spec.delete(geom)
    for side in ("left", "right"):
        foot = spec.body(f"{side}_ankle_roll_link")
        for i, corner in enumerate(_FOOT_CORNERS, start=1):
            foot.add_geom(
                name=f"{side}_foot{i}_collision",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[_POINT_RADIUS, 0, 0],
                pos=list(corner),
                group=3,
                contype=0,
                conaffinity=1,
                condim=3,
            )
