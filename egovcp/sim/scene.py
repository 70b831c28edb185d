"""MuJoCo models of the tasks: robot, floor, and ball, wall or arch, or all of them.

A model is compiled once per task and foot model; each simulated robot edits its own copy. Visual
meshes are left out: rays and contacts use the collision capsules, so a copy has 80 kB, not 70 MB.

Geom groups: 0 floor and objects, 3 robot. Robot geoms meet the geoms with contype 1.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.robot.mjcf import FootModel, robot_spec
from egovcp.sim.scenario import SEQUENCE
from egovcp.spec import JOINT_NAMES

_LOG = logging.getLogger(__name__)

# Keeps MuJoCo from printing warnings and writing MUJOCO_LOG.TXT: `SimulatedRobot.diverged` checks
# the counters of warnings.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(_LOG.debug)

FLOOR: Final = "floor"
BALL: Final = "ball"
WALL: Final = "wall"
ARCH: Final = "arch"
ARCH_GEOMS: Final = ("arch_left_post", "arch_right_post", "arch_lintel")
WALL_HALF_SIZE: Final = (0.05, 1.5, 1.3)  # m: thickness, width, height

#: Parts of the robot that contacts distinguish. The hand includes the wrist, the torso the pelvis,
#: the leg the foot; the arm is forearm and upper arm.
PARTS: Final = ("left_hand", "right_hand", "left_arm", "right_arm", "torso", "head", "leg")
HANDS: Final = (PARTS.index("left_hand"), PARTS.index("right_hand"))
TORSO: Final = PARTS.index("torso")
HEAD: Final = PARTS.index("head")
LEG: Final = PARTS.index("leg")

_PART_OF: Final = {
    "left_hand": "left_hand",
    "left_wrist": "left_hand",
    "right_hand": "right_hand",
    "right_wrist": "right_hand",
    "left_elbow_yaw": "left_arm",
    "left_shoulder_yaw": "left_arm",
    "right_elbow_yaw": "right_arm",
    "right_shoulder_yaw": "right_arm",
    "torso": "torso",
    "pelvis": "torso",
    "head": "head",
}


@dataclass(frozen=True)
class SceneIndex:
    """Addresses inside a compiled model; constant over its copies."""

    part: NDArray[np.int8]  # (ngeom,) index into ``PARTS`` of a robot geom, -1 otherwise
    is_object: NDArray[np.bool_]  # (ngeom,) ball, wall or arch
    floor: int  # Geom id of the floor
    foot_geoms: NDArray[np.intp]  # Geom ids of the feet
    robot_bodies: NDArray[np.intp]
    """Body ids of the robot: the pelvis first, in the order of ``body_names``."""
    body_names: tuple[str, ...]  # Names of ``robot_bodies``
    torso_body: int  # Body id of the torso, which carries the camera
    palm_sites: NDArray[np.intp]  # (2,) site ids of the left and the right palm
    joint_qpos: slice  # Joint positions in ``qpos``, ``JOINT_NAMES`` order
    joint_qvel: slice  # Joint velocities in ``qvel``, ``JOINT_NAMES`` order


@dataclass(frozen=True)
class Scene:
    """The pristine model of one task and its addresses."""

    model: mujoco.MjModel
    index: SceneIndex

    def copy_model(self) -> mujoco.MjModel:
        """A copy for one robot, to be edited per episode."""
        return copy.copy(self.model)


@cache
def build_scene(task: str, feet: FootModel) -> Scene:
    """The scene of ``task``, compiled once per process; that of a sequence holds all objects."""
    spec = robot_spec(feet)
    strip_visuals(spec)
    spec.worldbody.add_geom(
        name=FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=0
    )
    objects = tuple(_ADD) if task == SEQUENCE else (task,)
    for name in objects:
        _ADD[name](spec)
    # unused; they would compute accelerations
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
    model = spec.compile()
    return Scene(model, _index(model, objects))


def strip_visuals(spec: mujoco.MjSpec) -> None:
    """Drop the meshes; masses and inertias are explicit in the model and stay."""
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)


def _add_ball(spec: mujoco.MjSpec) -> None:
    body = spec.worldbody.add_body(name=BALL, pos=[-20, 0, 1])
    body.add_freejoint()
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    body.add_geom(name=BALL, type=sphere, size=[0.1, 0, 0], mass=0.25, contype=1, conaffinity=1)


def _add_box(body: mujoco.MjsBody, name: str, size: list[float], **options: Any) -> None:
    box = mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(name=name, type=box, size=size, contype=1, conaffinity=0, **options)


def _add_wall(spec: mujoco.MjSpec) -> None:
    body = spec.worldbody.add_body(name=WALL, mocap=True, pos=[20, 0, 0])
    centre = [WALL_HALF_SIZE[0], 0, WALL_HALF_SIZE[2]]
    _add_box(body, WALL, list(WALL_HALF_SIZE), pos=centre, priority=1)


def _add_arch(spec: mujoco.MjSpec) -> None:
    body = spec.worldbody.add_body(name=ARCH, mocap=True, pos=[20, 0, 0])
    for name in ARCH_GEOMS:
        _add_box(body, name, [0.1, 0.1, 0.1])


#: The ball comes last: its free joint is the last joint of the model.
_ADD: Final[dict[str, Callable[[mujoco.MjSpec], None]]] = {
    ARCH: _add_arch,
    WALL: _add_wall,
    BALL: _add_ball,
}


def _index(model: mujoco.MjModel, objects: Sequence[str]) -> SceneIndex:
    names = [model.geom(i).name for i in range(model.ngeom)]
    object_bodies = [model.body(name).id for name in objects]
    bodies = [i for i in range(1, model.nbody) if i not in object_bodies]
    first = model.joint(JOINT_NAMES[0])
    qpos, qvel = int(first.qposadr[0]), int(first.dofadr[0])
    return SceneIndex(
        part=np.array([_part(name) for name in names], dtype=np.int8),
        is_object=np.isin(model.geom_bodyid, object_bodies),
        floor=model.geom(FLOOR).id,
        foot_geoms=np.array([i for i, name in enumerate(names) if "_foot" in name]),
        robot_bodies=np.array(bodies),
        body_names=tuple(model.body(i).name for i in bodies),
        torso_body=model.body("torso_link").id,
        palm_sites=np.array([model.site(f"{side}_palm").id for side in ("left", "right")]),
        joint_qpos=slice(qpos, qpos + len(JOINT_NAMES)),
        joint_qvel=slice(qvel, qvel + len(JOINT_NAMES)),
    )


def _part(geom: str) -> int:
    """Index into ``PARTS`` of a geom name, -1 for floor and objects."""
    if not geom.endswith("_collision"):
        return -1
    part = _PART_OF.get(geom.removesuffix("_collision"), "leg")
    return PARTS.index(part)
