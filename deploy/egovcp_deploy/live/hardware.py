"""Connections to body and camera of a robot on the wall clock, and the options that select them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Literal

from egovcp_deploy.pilot.states import Limits
from egovcp_deploy.robots.bridge import BridgeConfig, BridgeRobot
from egovcp_deploy.robots.realsense_camera import RealSenseConfig, RealSenseDepthCamera
from egovcp_deploy.robots.zmq_camera import ZmqCameraConfig, ZmqDepthCamera

type AnyCamera = ZmqDepthCamera | RealSenseDepthCamera


@dataclass(frozen=True)
class CameraOptions:
    """The depth camera."""

    type: Literal["server", "realsense"] = "server"
    """server: a camera server, egovcp-depth-server or egovcp-fake-g1. realsense: a RealSense
    camera connected to this machine."""
    server: ZmqCameraConfig = field(default_factory=ZmqCameraConfig)
    """Address of the server."""
    realsense: RealSenseConfig = field(default_factory=RealSenseConfig)
    """Which RealSense camera."""


@dataclass(frozen=True)
class RobotOptions:
    """The robot: simulated, real or recorded; its connection, camera and safety limits."""

    type: Literal["sim", "unitree_g1", "replay"] = "sim"
    """sim: the simulated G1, in lock-step with the planner; unitree_g1: a G1, or egovcp-fake-g1,
    behind LeRobot's bridge, on the wall clock; replay: replan on recorded observations; no robot
    moves."""
    recordings: str = ""
    """For replay: an MCAP file, or a folder of them."""
    controller: str = "walk"
    """Low-level controller of a unitree_g1: walk, stance, or the file of a trained one; it must be
    that of the policy's data; the simulated robot uses --env.controller."""
    bridge: BridgeConfig = field(default_factory=BridgeConfig)
    """Address of the bridge of a unitree_g1."""
    camera: CameraOptions = field(default_factory=CameraOptions)
    """The depth camera of a unitree_g1."""
    limits: Limits = field(default_factory=Limits)
    """When the robot is held, when its motors are damped, and how long it takes to stand up."""


@dataclass(frozen=True)
class Hardware:
    """What the control loop reads and writes."""

    body: BridgeRobot
    camera: AnyCamera

    def link(self, now_ns: int) -> dict[str, float]:
        """Statistics of the messages of the last second, for the log: `Tick.link`."""
        states, images = self.body.arrivals.stats(now_ns), self.camera.arrivals.stats(now_ns)
        reading, image = self.body.read(), self.camera.read()
        figures = {
            "mode_machine": 0.0 if reading is None else float(reading.mode),
            **{f"state_{name}": value for name, value in asdict(states).items()},
            **{f"image_{name}": value for name, value in asdict(images).items()},
        }
        if image is not None and image.captured_ns is not None:
            figures["image_age_ms"] = (now_ns - image.captured_ns) / 1e6
        return figures

    def close(self) -> None:
        """Close both connections."""
        self.camera.close()
        self.body.close()


def open_hardware(bridge: BridgeConfig, camera: CameraOptions) -> Hardware:
    """Connect to body and camera; raises `EnvironmentFailure` if one does not answer."""
    body = BridgeRobot(bridge).connect()
    try:
        return Hardware(body, open_camera(camera))
    except BaseException:
        body.close()
        raise


def open_camera(options: CameraOptions) -> AnyCamera:
    """Connect to the camera; raises `EnvironmentFailure` if it does not answer."""
    if options.type == "realsense":
        return RealSenseDepthCamera.connect(options.realsense)
    return ZmqDepthCamera(options.server).connect()
