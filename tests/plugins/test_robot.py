"""The G1 as a LeRobot robot, against the fake one on the wall clock."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from functools import partialmethod
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import pytest
from lerobot.robots import RobotConfig, make_robot_from_config
from lerobot.scripts import lerobot_rollout
from lerobot.utils.errors import DeviceNotConnectedError
from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features

from egovcp import spec
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp_deploy.live.hardware import CameraOptions
from egovcp_deploy.pilot.states import Limits
from egovcp_deploy.robots.bridge import BridgeConfig, BridgeRobot
from egovcp_deploy.robots.zmq_camera import ZmqCameraConfig
from lerobot_robot_egovcp import EgovcpG1, EgovcpG1Config

#: A test is about the wire, not about how busy this machine is.
PATIENT = Limits(
    state_hold_s=5.0,
    state_damp_s=10.0,
    image_hold_s=5.0,
    planner_hold_s=5.0,
    misses_hold=1000,
    stand_s=0.5,
)


def config(tmp_path: Path, bridge: int = 1, command: int = 1, camera: int = 1) -> EgovcpG1Config:
    return EgovcpG1Config(
        calibration_dir=tmp_path,
        bridge=BridgeConfig(state_port=bridge, command_port=command),
        camera=CameraOptions(server=ZmqCameraConfig(port=camera)),
        controller="stance",
        limits=PATIENT,
        auto_start=True,
    )


@pytest.fixture
def robot(tmp_path: Path) -> EgovcpG1:
    """Not connected."""
    return EgovcpG1(config(tmp_path))


def test_lerobot_finds_the_robot_type(tmp_path: Path) -> None:
    assert RobotConfig.get_choice_class("egovcp_g1") is EgovcpG1Config
    made = make_robot_from_config(config(tmp_path))
    assert type(made) is EgovcpG1
    assert made.robot_type == "egovcp_g1"


def test_distribution_name_is_discovered_by_lerobot() -> None:
    try:
        name = distribution("lerobot_robot_egovcp").metadata["Name"]
    except PackageNotFoundError:
        pytest.skip("the plugin is not installed here")
    assert name.startswith("lerobot_robot_")


def test_it_records_what_our_datasets_hold(robot: EgovcpG1) -> None:
    seen = hw_to_dataset_features(robot.observation_features, "observation", use_video=False)
    done = hw_to_dataset_features(robot.action_features, "action", use_video=False)
    for key in (spec.STATE_KEY, spec.DEPTH_KEY):
        expected = spec.FEATURES[key]
        assert {name: seen[key][name] for name in expected} == expected
    assert done[spec.ACTION_KEY] == spec.FEATURES[spec.ACTION_KEY]


def test_methods_before_connect_raise(robot: EgovcpG1) -> None:
    assert not robot.is_connected
    for call in (robot.get_observation, robot.disconnect, lambda: robot.send_action(NEUTRAL)):
        with pytest.raises(DeviceNotConnectedError):
            call()


def test_no_robot_is_a_clear_failure(robot: EgovcpG1, monkeypatch: pytest.MonkeyPatch) -> None:
    impatient = partialmethod(BridgeRobot.connect, timeout=0.1)
    monkeypatch.setattr(BridgeRobot, "connect", impatient)
    with pytest.raises(EnvironmentFailure, match="nothing at"):
        robot.connect()
    assert not robot.is_connected


NEUTRAL = dict.fromkeys(spec.ACTION_NAMES, 0.0)


@pytest.fixture
def fake(tmp_path: Path) -> Iterator[EgovcpG1Config]:
    """A fake robot that stays on its gantry, and how to reach it."""
    command = [sys.executable, "-m", "egovcp_deploy.robots.fake.command", "--gantry=null"]
    ports = [f"--ports.{name}_port=0" for name in ("command", "state", "camera")]
    process = subprocess.Popen(
        [*command, *ports, "--env.controller=stance"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    line = next(line for line in process.stdout if "listening" in line)
    words = line.replace(",", "").replace(";", "").split()
    found = [int(words[words.index(name) + 1]) for name in ("states", "commands", "depth")]
    yield config(tmp_path, *found)
    process.communicate("quit\n", timeout=60)


def test_it_is_driven_with_seven_numbers(fake: EgovcpG1Config) -> None:
    robot = EgovcpG1(fake)
    features = hw_to_dataset_features(robot.observation_features, "observation", use_video=False)
    robot.connect()
    try:
        assert robot.is_connected
        wanted = NEUTRAL | {"left_hand.x": 0.5, "right_hand.z": -0.5}
        taken = NEUTRAL
        for _ in range(50):
            seen = robot.get_observation()
            taken = robot.send_action(wanted)
        row = build_dataset_frame(features, seen, prefix="observation")
        state, depth = row[spec.STATE_KEY], row[spec.DEPTH_KEY]
        assert state.shape == (spec.STATE_DIM,)
        assert depth.shape == (spec.DEPTH_ROWS, spec.DEPTH_COLS, 1)
        assert depth.dtype == np.uint16
        assert depth.any()
        assert taken == pytest.approx(wanted)
        commanded = spec.ACTION_BOX.to_metric(np.array([wanted[n] for n in spec.ACTION_NAMES]))
        np.testing.assert_allclose(state[spec.COMMAND_SLICE][3:], commanded, atol=1e-5)
        with pytest.raises(UsageError, match="lacks height"):
            robot.send_action({n: 0.0 for n in spec.ACTION_NAMES if n != "height"})
        with pytest.raises(UsageError, match="found"):
            robot.send_action(wanted | {"height": float("nan")})
    finally:
        robot.disconnect()
    assert not robot.is_connected


@pytest.mark.slow
def test_lerobot_rollout_plays_a_policy_on_it(
    fake: EgovcpG1Config, artifact: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[dict[str, float]] = []
    send = EgovcpG1.send_action

    def recorded(robot: EgovcpG1, action: dict[str, float]) -> dict[str, float]:
        sent.append(action)
        taken: dict[str, float] = send(robot, action)
        return taken

    monkeypatch.setattr(EgovcpG1, "send_action", recorded)
    options = {
        "policy.path": artifact,
        "policy.device": "cpu",
        "robot.type": "egovcp_g1",
        "robot.name_suffix": ".vel",
        "robot.auto_start": "true",
        "robot.calibration_dir": fake.calibration_dir,
        "robot.bridge.state_port": fake.bridge.state_port,
        "robot.bridge.command_port": fake.bridge.command_port,
        "robot.camera.server.port": fake.camera.server.port,
        "robot.controller": fake.controller,
        "robot.limits": json.dumps(asdict(fake.limits)),
        "fps": spec.PLANNER_HZ,
        "duration": 2,
    }
    argv = ["lerobot-rollout", *(f"--{name}={value}" for name, value in options.items())]
    monkeypatch.setattr(sys, "argv", argv)
    lerobot_rollout.main()
    assert len(sent) > 1
    assert all(list(action) == [f"{name}.vel" for name in spec.ACTION_NAMES] for action in sent)
