"""Constants of the G1, and its MuJoCo model."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from egovcp.errors import EnvironmentFailure
from egovcp.robot import g1
from egovcp.robot.g1 import ARMATURE, DAMPING, EFFORT_LIMIT, STIFFNESS
from egovcp.robot.mjcf import FootModel, robot_spec
from egovcp.spec import JOINT_NAMES


def test_model_path_is_the_file_in_the_wheel() -> None:
    assert g1.model_path().name == "g1.xml"
    assert g1.model_path().is_file()


def test_a_missing_wheel_is_an_environment_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mjlab", None)
    with pytest.raises(EnvironmentFailure, match=r"egovcp\[sim\]"):
        g1.model_path()


def test_a_wheel_without_the_model_is_an_environment_failure(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    spec = importlib.util.spec_from_file_location("mjlab", tmp_path / "__init__.py")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: spec)
    with pytest.raises(EnvironmentFailure, match=r"g1\.xml"):
        g1.model_path()


@pytest.mark.parametrize(
    ("joint", "armature", "stiffness", "damping", "effort"),
    [
        ("left_hip_pitch_joint", 0.010177520, 40.17923847, 2.557889765, 88.0),
        ("right_knee_joint", 0.025101925, 99.09842778, 6.308801854, 139.0),
        ("left_ankle_roll_joint", 2 * 0.003609725, 28.50124620, 1.814445687, 50.0),
        ("waist_yaw_joint", 0.010177520, 40.17923847, 2.557889765, 88.0),
        ("right_elbow_joint", 0.003609725, 14.25062310, 0.907222843, 25.0),
        ("left_wrist_yaw_joint", 0.00425, 16.77832748, 1.068141502, 5.0),
    ],
)
def test_constants_equal_the_published_ones(
    joint: str, armature: float, stiffness: float, damping: float, effort: float
) -> None:
    i = JOINT_NAMES.index(joint)
    got = [
        g1.ARMATURE[i],
        g1.PUBLISHED_STIFFNESS[i],
        g1.PUBLISHED_DAMPING[i],
        g1.EFFORT_LIMIT[i],
    ]
    np.testing.assert_allclose(got, [armature, stiffness, damping, effort], rtol=1e-6)


def test_leg_and_waist_gains_equal_the_published_ones() -> None:
    legs_and_waist = slice(0, g1.WAIST.stop)
    for ours, published in [
        (g1.STIFFNESS, g1.PUBLISHED_STIFFNESS),
        (g1.DAMPING, g1.PUBLISHED_DAMPING),
    ]:
        np.testing.assert_array_equal(ours[legs_and_waist], published[legs_and_waist])
        assert np.all(ours[g1.ARMS] > 0.9 * published[g1.ARMS])
        assert np.all(ours[g1.ARMS] != published[g1.ARMS])
    np.testing.assert_array_equal(g1.STIFFNESS[g1.ARMS], [80, 80, 60, 60, 30, 20, 20] * 2)
    np.testing.assert_array_equal(g1.DAMPING[g1.ARMS], [5, 5, 3, 3, 1.5, 1, 1] * 2)


def test_left_and_right_have_the_same_numbers() -> None:
    for values in (g1.STIFFNESS, g1.DAMPING, g1.ARMATURE, g1.EFFORT_LIMIT, g1.VELOCITY_LIMIT):
        np.testing.assert_array_equal(values[:6], values[6:12])
        np.testing.assert_array_equal(values[15:22], values[22:29])


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


def test_actuators_have_the_configured_gains_and_limits(stock: mujoco.MjModel) -> None:
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
    spec.worldbody.add_geom(name="floor", type=plane, size=[0, 0, 0.1], contype=1, conaffinity=1)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[2] = 0.7918
    mujoco.mj_forward(model, data)
    assert data.ncon == contacts
    for floor, robot in data.contact.geom:
        assert model.geom(floor).name == "floor"
        assert "_foot" in model.geom(robot).name


def test_self_collision_is_disabled(stock: mujoco.MjModel) -> None:
    assert not np.any(stock.geom_contype)
