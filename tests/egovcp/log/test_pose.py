"""The pose that logs show agrees with what the robot measured."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from egovcp.log.pose import robot_pose, robot_poses
from egovcp.log.tick import CameraView, RunInfo
from egovcp.robot.geometry import rotation_matrix
from egovcp.robot.kinematics import palm_positions
from egovcp.spec import STATE_SLICES


def turned(angle: float) -> np.ndarray:
    """Quaternion (w, x, y, z) of a turn about the vertical."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def test_without_base_pose_the_pelvis_is_at_its_commanded_height(make_tick: Any) -> None:
    pose = robot_pose(make_tick(0, bare=True))
    np.testing.assert_allclose(pose.positions_w[0], [0, 0, 0.7], atol=1e-6)
    np.testing.assert_allclose(pose.rotations_w[0], np.eye(3), atol=1e-6)


def test_without_base_pose_the_pelvis_has_the_tilt_of_the_imu(make_tick: Any) -> None:
    tick = make_tick(0, bare=True)
    tick.state[STATE_SLICES["projected_gravity"]] = (np.sin(0.3), 0.0, -np.cos(0.3))
    pose = robot_pose(tick)
    np.testing.assert_allclose(
        pose.rotations_w[0] @ [np.sin(0.3), 0, -np.cos(0.3)], [0, 0, -1], atol=1e-6
    )
    np.testing.assert_allclose(pose.heading_w, np.eye(3), atol=1e-6)


def test_palms_are_where_forward_kinematics_puts_them(make_tick: Any) -> None:
    tick = replace(make_tick(3), base=np.array([1.0, 2.0, 0.6, *turned(0.8)]))
    pose = robot_pose(tick)
    np.testing.assert_allclose(
        pose.palms_w, pose.from_heading(palm_positions(tick.state[None])[0]), atol=1e-6
    )


def test_the_heading_frame_turns_with_the_pelvis(make_tick: Any) -> None:
    base = np.array([1.0, 2.0, 0.6, *turned(np.pi / 2)])
    pose = robot_pose(replace(make_tick(0), base=base))
    np.testing.assert_allclose(
        pose.from_heading(np.array([1.0, 0.0, 0.1])), [1.0, 3.0, 0.7], atol=1e-9
    )


def test_several_ticks_at_once_equal_one_at_a_time(make_tick: Any) -> None:
    ticks = [make_tick(0), make_tick(1, bare=True), make_tick(2)]
    for tick, pose in zip(ticks, robot_poses(ticks), strict=True):
        np.testing.assert_allclose(pose.positions_w, robot_pose(tick).positions_w, atol=1e-12)


@pytest.mark.parametrize("pitch", [0.0, 0.3])
def test_the_camera_looks_ahead_and_down_by_its_pitch(make_tick: Any, pitch: float) -> None:
    tick = make_tick(0, bare=True)
    tick.state[STATE_SLICES["joint_position"]] = 0.0
    _, rotation = robot_pose(tick).camera(CameraView(pitch=pitch))
    np.testing.assert_allclose(rotation[:, 2], [np.cos(pitch), 0, -np.sin(pitch)], atol=1e-6)
    np.testing.assert_allclose(rotation[:, 0], [0, -1, 0], atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_quaternion_to_matrix_turns_x_to_y() -> None:
    np.testing.assert_allclose(
        rotation_matrix(turned(np.pi / 2)) @ [1, 0, 0], [0, 1, 0], atol=1e-12
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("fps", "0"), ("fps", "-25"), ("seed", "[1]"), ("hashes", "[1]"), ("versions", "5")),
        *(("config", "[]"), ("camera", '{"position": [1]}'), ("camera", '{"vertical_fov": 0}')),
        ("config", "[" * 10_000),
    ],
)
def test_metadata_of_another_type_is_a_value_error(name: str, value: str) -> None:
    with pytest.raises(ValueError, match=f"{name}|nested"):
        RunInfo.from_metadata(RunInfo("wall").to_metadata() | {name: value})


def test_run_info_round_trips_through_metadata() -> None:
    info = RunInfo(
        "wall", 5, 6, camera=CameraView(position=(0.1, 0.2, 0.3)), config={"a": {"b": [1]}}
    )
    assert RunInfo.from_metadata(info.to_metadata()) == info
    assert all(isinstance(value, str) for value in info.to_metadata().values())
