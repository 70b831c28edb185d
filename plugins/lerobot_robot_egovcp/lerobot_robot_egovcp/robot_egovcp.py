"""A Unitree G1 as a LeRobot robot, ``--robot.type=egovcp_g1``."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from egovcp import spec
from egovcp.errors import UsageError
from egovcp_deploy.live.external_policy import ExternalPolicyRobot
from egovcp_deploy.live.hardware import CameraOptions, RobotOptions
from egovcp_deploy.live.operators import AutomaticOperator
from egovcp_deploy.pilot.states import Limits
from egovcp_deploy.robots.bridge import BridgeConfig

_DEPTH = spec.DEPTH_KEY.removeprefix("observation.images.")


@RobotConfig.register_subclass("egovcp_g1")
@dataclass(kw_only=True)
class EgovcpG1Config(RobotConfig):  # type: ignore[misc]
    """A G1 behind LeRobot's bridge, or egovcp-fake-g1."""

    bridge: BridgeConfig = field(default_factory=BridgeConfig)
    """Address of the bridge."""
    camera: CameraOptions = field(default_factory=CameraOptions)
    """The depth camera."""
    controller: str = "walk"
    """Low-level controller: walk, stance, or the file of a trained one."""
    limits: Limits = field(default_factory=Limits)
    """Limits at which the robot holds its pose or its motors are damped."""
    name_suffix: str = ""
    """Suffix of the names of states and actions: ``.vel`` for lerobot-rollout, which passes a
    policy only values that are named ``*.pos`` or ``*.vel``."""
    auto_start: bool = False
    """Whether `connect` requests that the robot stands up, arms and runs, for egovcp-fake-g1. Else
    use its remote control: Y, A, start."""

    @property
    def options(self) -> RobotOptions:
        return RobotOptions(
            "unitree_g1",
            controller=self.controller,
            bridge=self.bridge,
            camera=self.camera,
            limits=self.limits,
        )


class EgovcpG1(Robot):  # type: ignore[misc]
    """Takes egovcp actions at 25 Hz; its observations have the features of egovcp datasets.

    The robot balances, holds its pose if actions stop, and is damped if it falls. Untested on
    hardware.
    """

    config_class = EgovcpG1Config
    name = "egovcp_g1"

    def __init__(self, config: EgovcpG1Config) -> None:
        super().__init__(config)
        self.config = config
        self._robot: ExternalPolicyRobot | None = None

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """Proprioception by name, and the depth image."""
        image = (spec.DEPTH_ROWS, spec.DEPTH_COLS, 1)
        return {**dict.fromkeys(self._named(spec.STATE_NAMES), float), _DEPTH: image}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self._named(spec.ACTION_NAMES), float)

    @property
    def cameras(self) -> dict[str, Any]:
        """Empty: the depth image is part of the observation."""
        return {}

    @property
    def is_connected(self) -> bool:
        return self._robot is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Wait up to 120 s until the robot runs, brought there by its remote control, or, with
        ``auto_start``, by requests of this program.

        Raises:
            DeviceAlreadyConnectedError: it is connected.
            EnvironmentFailure: robot or camera do not answer, or the robot does not run in time.
            SafetyStop: its motors were damped.
        """
        if self._robot is not None:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        operator = AutomaticOperator() if self.config.auto_start else None
        robot = ExternalPolicyRobot(self.config.options, operator)
        robot.connect()
        self._robot = robot

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def get_observation(self) -> dict[str, Any]:
        """The next observation: `spec.STATE_NAMES`, and ``ego_depth`` (48, 64, 1) uint16 mm."""
        observation = self._running.observe()
        names = self._named(spec.STATE_NAMES)
        state = dict(zip(names, observation.state.tolist(), strict=True))
        return {**state, _DEPTH: observation.depth[..., None].copy()}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send `spec.ACTION_NAMES`, each in [-1, 1]; returns the rate-limited action."""
        names = self._named(spec.ACTION_NAMES)
        missing = [name for name in names if name not in action]
        if missing:
            raise UsageError(f"the action lacks {missing[0]}; expected {names}")
        taken = self._running.send(np.array([float(action[name]) for name in names]))
        return dict(zip(names, taken.tolist(), strict=True))

    def disconnect(self) -> None:
        """Hold, then damp. Suspend the robot first."""
        robot, self._robot = self._running, None
        robot.close()

    def _named(self, names: tuple[str, ...]) -> list[str]:
        return [name + self.config.name_suffix for name in names]

    @property
    def _running(self) -> ExternalPolicyRobot:
        if self._robot is None:
            raise DeviceNotConnectedError(f"{self} is not connected; call connect()")
        return self._robot
