"""`--dry_run` with a robot: one line per check, with what to do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egovcp.errors import EnvironmentFailure
from egovcp.robot.stance_table import standing_pose
from egovcp.sim.live import LiveRobot
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_BOX, JOINT_NAMES
from egovcp_deploy.deploy import main
from egovcp_deploy.dry_run import (
    check_joint_positions,
    check_message_rate,
    check_posture,
    image_age,
)
from egovcp_deploy.robots.base import LowState
from egovcp_deploy.robots.fake.bridge import FakeBridge, Ports
from egovcp_deploy.robots.subscriber import ArrivalStats
from tests.support.robots.fake_g1 import FakeG1Thread
from tests.support.robots.fault_messages import edited, without_motor_fields

NEUTRAL = standing_pose(ACTION_BOX.neutral[-1]).joints
KNEE = JOINT_NAMES.index("left_knee_joint")


def moved(joint: int, by: float) -> np.ndarray:
    joints = NEUTRAL.copy()
    joints[joint] += by
    return joints


def pitched(angle: float) -> LowState:
    quaternion = np.array([np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0])
    return LowState(0, NEUTRAL, np.zeros(29), quaternion, np.zeros(3))


def test_the_joint_farthest_from_neutral_is_named() -> None:
    assert "+0.00 rad from neutral" in check_joint_positions(NEUTRAL)
    words = check_joint_positions(moved(KNEE, -0.5))
    assert words == "largest offset: left_knee_joint is -0.50 rad from neutral"


def test_a_joint_far_from_neutral_or_outside_its_range_is_a_no_go() -> None:
    with pytest.raises(EnvironmentFailure, match=r"left_knee_joint is \+1.80 rad from neutral"):
        check_joint_positions(moved(KNEE, 1.8))
    with pytest.raises(EnvironmentFailure, match=r"left_knee_joint reports .* calibrate its zero"):
        check_joint_positions(moved(KNEE, -1.2))


def test_the_posture_has_tilt_and_height() -> None:
    assert check_posture(pitched(0.0)) == (
        "IMU 0.00 rad from upright, pelvis 0.74 m above the lower foot"
    )
    assert "0.25 rad from upright" in check_posture(pitched(0.25))


def test_a_robot_that_is_not_upright_is_a_no_go() -> None:
    with pytest.raises(EnvironmentFailure, match=r"tilted by 0.50 rad.*hang the robot up upright"):
        check_posture(pitched(0.5))


@pytest.mark.parametrize(
    ("stats", "expected"),
    [
        (ArrivalStats(60.0, 1.0, 20.0, 0.0), "at least 100 per second"),
        (ArrivalStats(200.0, 1.0, 150.0, 0.0), "gaps of at most 100 ms"),
        (ArrivalStats(200.0, 1.0, 20.0, 0.08), "at most 5% lost"),
    ],
)
def test_a_bad_connection_is_a_no_go(stats: ArrivalStats, expected: str) -> None:
    with pytest.raises(EnvironmentFailure, match=expected):
        check_message_rate(stats, 100.0, 100.0)


def test_a_good_connection_in_figures() -> None:
    assert check_message_rate(ArrivalStats(200.0, 1.2, 20.0, 0.01), 100.0, 100.0) == (
        "200 per second, jitter 1.2 ms (p99), longest gap 20 ms, 1.0% lost"
    )


def test_the_age_of_images_is_checked_if_the_camera_reports_it() -> None:
    assert image_age([], 80.0).startswith("not measured")
    assert image_age([30.0, 40.0, 50.0], 80.0).startswith("40 ms when they arrive")
    with pytest.raises(EnvironmentFailure, match="expected at most 80"):
        image_age([90.0, 95.0], 80.0)


type Look = Callable[..., tuple[int, dict[str, str]]]


@pytest.fixture
def look(
    robot: LiveRobot,
    artifact_dir: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> Look:
    """``look(change, ...)``: a dry run before a fake robot; exit code and line per check.

    The limits of the connection are those of a busy machine. The working folder is ``tmp_path``.
    """
    monkeypatch.chdir(tmp_path)
    limits = {"STATE_HZ": 5.0, "IMAGE_HZ": 1.0, "MAX_LOST": 0.95, "LISTEN_S": 1.5}
    for name, value in limits.items():
        monkeypatch.setattr(f"egovcp_deploy.dry_run.{name}", value)
    monkeypatch.setattr("egovcp_deploy.robots.bridge.GAP_S", 2.0)

    def look(change: Callable[[FakeBridge], object], detailed: bool = True) -> Any:
        robot.start(Scenario("ball", 0, 0))
        ports = Ports(command_port=0, state_port=0, camera_port=0)
        fake = FakeBridge(robot, ports, detailed=detailed)
        change(fake)
        running = FakeG1Thread(fake)
        try:
            code = main(
                [
                    *("--dry_run=true", "--robot.type=unitree_g1", "--robot.controller=stance"),
                    f"--policy.path={artifact_dir}",
                    f"--robot.bridge.state_port={fake.ports.state_port}",
                    f"--robot.bridge.command_port={fake.ports.command_port}",
                    f"--robot.camera.server.port={fake.ports.camera_port}",
                    *("--robot.limits.state_hold_s=5", "--robot.limits.state_damp_s=10"),
                    *("--robot.limits.image_hold_s=5", "--env.delay.image_age=[0.02,1.0]"),
                    *("--planner.samples=16", "--planner.elites=4"),
                ]
            )
        finally:
            running.stop()
            fake.close()
        lines = [line for line in capsys.readouterr().out.splitlines() if ": " in line]
        return code, {line[7:].partition(": ")[0]: line for line in lines}

    return look


def test_a_healthy_robot_is_go_in_every_line(look: Look) -> None:
    def settle(fake: FakeBridge) -> None:
        """Its limp joints come to rest; the damping torques of moving ones are not commanded."""
        for _ in range(400):
            fake.step()

    _, lines = look(settle)
    checks = ["mode", "joints", "posture", "motors", "states", "arming"]
    checks += ["controller", "robot", "camera", "images", "image age"]
    assert [lines[name] for name in checks if not lines[name].startswith("go")] == []
    assert "mode machine 5: 29 joints, waist free" in lines["mode"]
    assert "casing 35 deg C, winding 35 deg C" in lines["motors"]
    assert "when they arrive" in lines["image age"]


def test_a_missing_real_time_priority_is_a_warning(
    look: Look, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("egovcp_deploy.dry_run.raise_priority", lambda level: False)
    _, lines = look(lambda fake: None)
    assert lines["priority"].startswith("warn")
    assert "'USER - rtprio 20'" in lines["priority"]


def test_it_needs_no_output_dir_and_writes_nothing(look: Look, tmp_path: Path) -> None:
    before = sorted(tmp_path.iterdir())
    code, lines = look(lambda fake: None)
    assert code != 2
    assert "images" in lines
    assert sorted(tmp_path.iterdir()) == before


def test_a_hot_motor_is_a_no_go_and_named(look: Look) -> None:
    code, lines = look(lambda fake: fake.faults.apply("hot_motor left_ankle_roll 110"))
    assert code == 5
    assert lines["motors"].startswith("NO-GO")
    assert "left_ankle_roll_joint is at casing 35 deg C, winding 110 deg C" in lines["motors"]


def without_temperatures(fake: FakeBridge) -> None:
    fake.alter_state = edited(without_motor_fields("temperature"))


def test_a_bridge_without_temperatures_is_go_and_says_which_checks_are_off(look: Look) -> None:
    _, lines = look(without_temperatures, detailed=False)
    assert lines["motors"].startswith("go")
    assert "no temperatures are reported; checks that are off" in lines["motors"]


def test_a_robot_with_a_locked_waist_is_a_no_go(look: Look) -> None:
    code, lines = look(lambda fake: fake.faults.apply("mode 6"))
    assert code == 5
    assert lines["robot"].startswith("NO-GO")
    assert "waist is locked" in lines["robot"]
    assert lines["image age"].startswith("go"), "the camera is looked at all the same"


def test_an_unusual_mode_is_a_warning(look: Look) -> None:
    _, lines = look(lambda fake: fake.faults.apply("mode 7"))
    assert lines["mode"].startswith("warn   mode: mode machine 7 is not known")


def test_another_program_that_commands_is_a_no_go(look: Look) -> None:
    code, lines = look(lambda fake: fake.faults.apply("other_publisher"))
    assert code == 5
    assert lines["arming"].startswith("NO-GO")
