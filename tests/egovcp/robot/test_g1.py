"""The restated constants agree with the model and with mjlab's published numbers."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from egovcp.errors import EnvironmentFailure
from egovcp.robot import g1
from egovcp.spec import JOINT_NAMES


def test_model_path_is_the_wheels_file() -> None:
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
def test_constants_restate_the_published_ones(
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


def test_only_the_arms_gains_differ_from_the_published_ones() -> None:
    legs_and_waist = slice(0, g1.WAIST.stop)
    for ours, published in [
        (g1.STIFFNESS, g1.PUBLISHED_STIFFNESS),
        (g1.DAMPING, g1.PUBLISHED_DAMPING),
    ]:
        np.testing.assert_array_equal(ours[legs_and_waist], published[legs_and_waist])
        assert np.all(ours[g1.ARMS] > 0.9 * published[g1.ARMS])


def test_left_and_right_have_the_same_numbers() -> None:
    for values in (g1.STIFFNESS, g1.DAMPING, g1.ARMATURE, g1.EFFORT_LIMIT, g1.VELOCITY_LIMIT):
        np.testing.assert_array_equal(values[:6], values[6:12])
        np.testing.assert_array_equal(values[15:22], values[22:29])
