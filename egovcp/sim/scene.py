"""MuJoCo models of the tasks: robot, floor, and the objects of one task or of several.

A model is compiled once per task and foot model; each simulated robot edits its own copy. Visual
meshes are left out: rays and contacts use the collision capsules, so a copy has 80 kB, not 70 MB.

Geom groups: 0 floor and objects, 3 robot. Robot geoms meet the geoms with contype 1.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.robot.mjcf import FootModel, robot_spec
from egovcp.spec import JOINT_NAMES

if TYPE_CHECKING:
    from egovcp.sim.tasks.base import Task

_LOG = logging.getLogger(__name__)

# Keeps MuJoCo from printing warnings and writing MUJOCO_LOG.TXT: `SimulatedRobot.diverged` checks
# the counters of warnings.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(_LOG.debug)

FLOOR: Final = "floor"

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
class Contact:
    """A contact of the robot with the task's object in one physics step."""

    part: int  # Index into `PARTS`
    force: float  # Normal force, N


@dataclass(frozen=True)
class SceneIndex:
    """Addresses inside a compiled model; constant over its copies."""

    part: NDArray[np.int8]  # (ngeom,) index into ``PARTS`` of a robot geom, -1 otherwise
    is_object: NDArray[np.bool_]  # (ngeom,) part of a task's object
    objects: Mapping[str, tuple[int, ...]]  # Task -> geom ids of its objects
    floor: int  # Geom id of the floor
    foot_geoms: NDArray[np.intp]  # Geom ids of the feet
    robot_bodies: NDArray[np.intp]  # Body ids of the robot, the pelvis first
    torso_body: int  # Body id of the torso, which carries the camera
    palm_sites: NDArray[np.intp]  # (2,) site ids of the left and the right palm
    joint_qpos: slice  # Joint positions in ``qpos``, ``JOINT_NAMES`` order
    joint_qvel: slice  # Joint velocities in ``qvel``, ``JOINT_NAMES`` order


@dataclass(frozen=True)
class Scene:
    """The pristine model of one task and its addresses."""

    model: mujoco.MjModel
    index: SceneIndex


@cache
def build_scene(tasks: tuple[type[Task], ...], feet: FootModel) -> Scene:
    """The scene with the objects of ``tasks``, compiled once per process.

    Raises:
        EnvironmentFailure: the objects of a task do not compile; the message names it.
    """
    spec = robot_spec(feet)
    strip_visuals(spec)
    spec.worldbody.add_geom(
        name=FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=0
    )
    # unused; they would compute accelerations
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
    objects: dict[str, set[str]] = {}  # task -> names of its bodies
    known = {body.name for body in spec.bodies}
    for task in tasks:
        try:
            task.add_objects(spec)
            names = [body.name for body in spec.bodies]
            if "" in names or len(set(names)) < len(names):
                raise ValueError("each of its bodies needs a name that no other body has")
            objects[task.name] = set(names) - known
            known.update(names)
            model = spec.compile()  # after each task, so that the error names the right one
            if model.nu != len(JOINT_NAMES):
                raise ValueError("it adds actuators, which only the robot has")
        except Exception as error:
            problem = " ".join(str(error).split()) or type(error).__name__
            raise task.error(f"its scene does not compile: {problem}") from error
    return Scene(model, _index(model, objects))


def strip_visuals(spec: mujoco.MjSpec) -> None:
    """Drop the meshes; masses and inertias are explicit in the model and stay."""
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH:
            spec.delete(geom)
    for mesh in list(spec.meshes):
        spec.delete(mesh)


def _index(model: mujoco.MjModel, objects: Mapping[str, set[str]]) -> SceneIndex:
    names = [model.geom(i).name for i in range(model.ngeom)]
    owner = {model.body(body).id: task for task, own in objects.items() for body in own}
    object_bodies = list(owner)
    is_object = np.isin(model.geom_bodyid, object_bodies)
    robot_names = ["" if own else name for name, own in zip(names, is_object, strict=True)]
    first = model.joint(JOINT_NAMES[0])
    qpos, qvel = int(first.qposadr[0]), int(first.dofadr[0])
    return SceneIndex(
        part=np.array([_part(name) for name in robot_names], dtype=np.int8),
        is_object=is_object,
        objects={
            task: tuple(
                geom for geom, body in enumerate(model.geom_bodyid) if owner.get(body) == task
            )
            for task in objects
        },
        floor=model.geom(FLOOR).id,
        foot_geoms=np.array([i for i, name in enumerate(robot_names) if "_foot" in name]),
        robot_bodies=np.setdiff1d(np.arange(1, model.nbody), object_bodies),
        torso_body=model.body("torso_link").id,
        palm_sites=np.array([model.site(f"{side}_palm").id for side in ("left", "right")]),
        joint_qpos=slice(qpos, qpos + len(JOINT_NAMES)),
        joint_qvel=slice(qvel, qvel + len(JOINT_NAMES)),
    )


def _part(geom: str) -> int:
    """Index into ``PARTS`` of a geom name, -1 for the floor and no name."""
    if not geom.endswith("_collision"):
        return -1
    part = _PART_OF.get(geom.removesuffix("_collision"), "leg")
    return PARTS.index(part)
