"""``--robot.type=egovcp_g1``: where the robot and its camera are, and who lets it run."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.robots import RobotConfig

from egovcp_deploy.live.hardware import CameraOptions, HardwareOptions
from egovcp_deploy.live.run import LiveSetup
from egovcp_deploy.pilot.states import Limits
from egovcp_deploy.robots.bridge import BridgeConfig


@RobotConfig.register_subclass("egovcp_g1")
@dataclass(kw_only=True)
class EgovcpG1Config(RobotConfig):  # type: ignore[misc]
    """A G1 behind LeRobot's bridge, or egovcp-fake-g1."""

    bridge: BridgeConfig = field(default_factory=BridgeConfig)
    """Where the bridge is."""
    camera: CameraOptions = field(default_factory=CameraOptions)
    """The depth camera."""
    controller: str = "walk"
    """Low-level controller: walk, stance, or the file of a trained one. Data of different ones do
    not mix."""
    limits: Limits = field(default_factory=Limits)
    """When the robot is held, and when its motors are damped."""
    by_itself: bool = False
    """Whether it stands up, arms and runs by itself when it is connected: for egovcp-fake-g1. Else
    somebody does that with the robot's remote control: Y, A, start."""

    @property
    def setup(self) -> LiveSetup:
        """What the control process is told."""
        hardware = HardwareOptions(self.bridge, self.camera)
        return LiveSetup(hardware, self.controller, self.limits, stays=False)
