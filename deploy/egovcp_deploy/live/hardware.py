"""Body and camera of a robot on the wall clock, from the options that name them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Final

from egovcp_deploy.robots.bridge import BridgeConfig, BridgeRobot
from egovcp_deploy.robots.realsense_camera import RealSenseConfig, RealSenseDepthCamera
from egovcp_deploy.robots.zmq_camera import ZmqCameraConfig, ZmqDepthCamera

REALSENSE: Final = "realsense"
CAMERAS: Final = ("server", REALSENSE)


@dataclass(frozen=True)
class CameraOptions:
    """Which depth camera."""

    type: str = "server"
    """server: one that sends pictures, egovcp-depth-server or egovcp-fake-g1. realsense: one at
    this machine."""
    server: ZmqCameraConfig = field(default_factory=ZmqCameraConfig)
    """Where the server is."""
    realsense: RealSenseConfig = field(default_factory=RealSenseConfig)
    """Which RealSense camera."""


@dataclass(frozen=True)
class HardwareOptions:
    """A G1 behind LeRobot's bridge, and its depth camera."""

    bridge: BridgeConfig = field(default_factory=BridgeConfig)
    """LeRobot's bridge on the robot, or egovcp-fake-g1."""
    camera: CameraOptions = field(default_factory=CameraOptions)
    """The depth camera."""


@dataclass(frozen=True)
class Hardware:
    """What the control loop reads and writes."""

    body: BridgeRobot
    eye: ZmqDepthCamera | RealSenseDepthCamera

    def link(self, now_ns: int) -> dict[str, float]:
        """How the messages of the last second arrived, for the log: `Tick.link`."""
        states, images = self.body.arrivals.stats(now_ns), self.eye.arrivals.stats(now_ns)
        reading, picture = self.body.read(), self.eye.read()
        found = {
            "mode_machine": 0.0 if reading is None else float(reading.mode),
            **{f"state_{name}": value for name, value in asdict(states).items()},
            **{f"image_{name}": value for name, value in asdict(images).items()},
        }
        if picture is not None and picture.captured_ns is not None:
            found["image_age_ms"] = (now_ns - picture.captured_ns) / 1e6
        return found

    def close(self) -> None:
        """Let go of both."""
        self.eye.close()
        self.body.close()


def open_hardware(options: HardwareOptions) -> Hardware:
    """Connect to both.

    Raises:
        EnvironmentFailure: one does not answer.
    """
    body = BridgeRobot(options.bridge)
    body.connect()
    try:
        return Hardware(body, open_eye(options.camera))
    except BaseException:
        body.close()
        raise


def open_eye(options: CameraOptions) -> ZmqDepthCamera | RealSenseDepthCamera:
    """Connect to the camera.

    Raises:
        EnvironmentFailure: it does not answer.
    """
    if options.type == REALSENSE:
        return RealSenseDepthCamera.connect(options.realsense)
    eye = ZmqDepthCamera(options.server)
    eye.connect()
    return eye
