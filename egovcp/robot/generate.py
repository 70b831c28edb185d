"""Generates the tables that the robot package ships: ``python -m egovcp.robot.generate``.

Needs MuJoCo and SciPy (the simulator extra).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from egovcp.robot.mjcf import robot_spec
from egovcp.robot.stance_design import (
    StanceModel,
    balanced_pose,
    compensator,
    linearise,
    load_response,
    pitch_at,
)
from egovcp.robot.stance_table import NU
from egovcp.spec import JOINT_NAMES

PACKAGE = Path(__file__).parent
HEIGHTS = tuple(round(0.50 + 0.02 * i, 2) for i in range(15))  # m


def kinematic_table(model: mujoco.MjModel) -> dict[str, Any]:
    """Link tree, offsets, masses, joint axes and limits of the model, as plain lists."""
    joints = [model.joint(name) for name in JOINT_NAMES]
    links = [int(model.joint("floating_base_joint").bodyid[0])]
    links += [int(joint.bodyid[0]) for joint in joints]
    rest = np.zeros((len(joints), 9))
    for row, link in zip(rest, links[1:], strict=True):
        mujoco.mju_quat2Mat(row, model.body_quat[link])
    return {
        "links": [model.body(link).name for link in links],
        "parent": [-1, *(links.index(int(model.body_parentid[link])) for link in links[1:])],
        "offset": model.body_pos[links[1:]].tolist(),
        "rest": rest.reshape(-1, 3, 3).tolist(),
        "axis": [joint.axis.tolist() for joint in joints],
        "lower": [float(joint.range[0]) for joint in joints],
        "upper": [float(joint.range[1]) for joint in joints],
        "mass": model.body_mass[links].tolist(),
        "com": model.body_ipos[links].tolist(),
        "palm": [model.site(f"{side}_palm").pos.tolist() for side in ("left", "right")],
    }


def stance_row(stance: StanceModel, height: float) -> dict[str, NDArray[np.floating]]:
    """All numbers of the stance law at one pelvis height."""
    pose = balanced_pose(stance, height)
    linear = linearise(stance, pose)
    response = load_response(stance, pose, height)
    return {
        "height": np.array(height),
        "pelvis": np.array([pose.qpos[0], pose.qpos[1], float(pitch_at(height))]),
        "joints": pose.qpos[7:22],
        "torque": pose.torque,
        "pelvis_per_moment": response[:, :2].T,
        "joints_per_moment": response[:, 2 : 2 + NU].T,
        "torque_per_moment": response[:, 2 + NU :].T,
        "mobility": linear.mobility,
        "compensator": compensator(linear).astype(np.float32),
    }


def main() -> None:
    """Regenerate every table in place."""
    model = robot_spec().compile()
    table = json.dumps(kinematic_table(model), indent=1) + "\n"
    (PACKAGE / "g1_kinematics.json").write_text(table, encoding="utf-8")
    stance = StanceModel(model)
    rows = [stance_row(stance, height) for height in HEIGHTS]
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    np.savez(PACKAGE / "g1_stance.npz", allow_pickle=False, **arrays)


if __name__ == "__main__":
    main()
