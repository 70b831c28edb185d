"""The MuJoCo spec: servos in joint order, feet, contacts."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from egovcp.robot.g1 import ARMATURE, DAMPING, EFFORT_LIMIT, STIFFNESS
from egovcp.robot.mjcf import FootModel, robot_spec
from egovcp.spec import JOINT_NAMES


@pytest.fixture(scope="module")
def stock() -> mujoco.MjModel:
    return robot_spec("stock").compile()


@pytest.fixture(scope="module")
def points() -> mujoco.MjModel:
    return robot_spec("points").compile()


def test_actuators_and_joints_are_in_the_order_of_the_spec(stock: mujoco.MjModel) -> None:
    assert [stock.actuator(i).name for i in range(stock.nu)] == list(JOINT_NAMES)
    assert [stock.joint(i).name for i in range(1, stock.njnt)] == list(JOINT_NAMES)
    assert stock.actuator_trnid[:, 0].tolist() == list(range(1, stock.njnt))


def test_servos_run_the_gains_and_limits(stock: mujoco.MjModel) -> None:
    np.testing.assert_allclose(stock.actuator_gainprm[:, 0], STIFFNESS)
    np.testing.assert_allclose(-stock.actuator_biasprm[:, 2], DAMPING)
    np.testing.assert_allclose(stock.actuator_forcerange[:, 1], EFFORT_LIMIT)
    np.testing.assert_allclose(stock.dof_armature[6:], ARMATURE)


def _lowest_foot_point(model: mujoco.MjModel, side: str) -> float:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    feet = [i for i in range(model.ngeom) if f"{side}_foot" in model.geom(i).name]
    return float(min(data.geom_xpos[i, 2] - model.geom_size[i, 0] for i in feet))


@pytest.mark.parametrize("side", ["left", "right"])
def test_both_foot_models_have_their_soles_at_the_same_height(
    stock: mujoco.MjModel, points: mujoco.MjModel, side: str
) -> None:
    assert _lowest_foot_point(stock, side) == pytest.approx(_lowest_foot_point(points, side))


@pytest.mark.parametrize(("feet", "contacts"), [("points", 8), ("stock", 28)])
def test_standing_on_a_floor_makes_foot_contacts_only(feet: FootModel, contacts: int) -> None:
    spec = robot_spec(feet)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(type=plane, size=[0, 0, 0.1], contype=1, conaffinity=1)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[2] = 0.7918
    mujoco.mj_forward(model, data)
    assert data.ncon == contacts


def test_the_robot_never_collides_with_itself(stock: mujoco.MjModel) -> None:
    assert not np.any(stock.geom_contype)
