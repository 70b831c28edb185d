"""`egovcp-depth-server`: publishes the depth camera of this machine for a planner elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Final

import zmq

from egovcp.bounds import bounded
from egovcp.cli import run_command
from egovcp.errors import EnvironmentFailure
from egovcp.rate import NS_PER_S, FixedRate, MonotonicClock, RateLimiter
from egovcp.terminal import echo
from egovcp_deploy.robots.base import DepthImage
from egovcp_deploy.robots.realsense_camera import RealSenseConfig, RealSenseDepthCamera
from egovcp_deploy.robots.subscriber import bind_socket
from egovcp_deploy.robots.wire import CAMERA_PORT
from egovcp_deploy.robots.zmq_camera import DepthFrame, encode_frame

PROG: Final = "egovcp-depth-server"
_POLL_HZ: Final = 200
_WARN_S: Final = 1.0  # without a new image
_FAIL_S: Final = 5.0


@dataclass(frozen=True)
class DepthServerConfig:
    """Publish the images of a RealSense depth camera, resampled to the policy's size.

    Untested on hardware.
    """

    camera: RealSenseConfig = field(default_factory=RealSenseConfig)
    """RealSense camera and its mode."""
    host: str = "127.0.0.1"
    """Interface to listen on. The default is reachable from this machine only; give the address of
    the robot's network to serve that network."""
    port: int = bounded(CAMERA_PORT, least=0, most=65535)
    """Port; 0: any free one."""


class DepthServer:
    """Publishes each image of a camera once; raises `EnvironmentFailure` if the port is in use."""

    def __init__(
        self, camera: RealSenseDepthCamera, vertical_fov: float, host: str, port: int
    ) -> None:
        self._camera, self._fov = camera, vertical_fov
        self._image_ns, self._warnings = time.monotonic_ns(), RateLimiter(1.0)
        self._last: DepthImage | None = None
        self._sequence = 0
        self._context = zmq.Context()
        self._end = self._context.socket(zmq.PUB)
        self._end.setsockopt(zmq.SNDHWM, 2)
        try:
            self.port = bind_socket(self._end, host, port)
        except EnvironmentFailure:
            self.close()
            raise

    def step(self) -> None:
        """Publish the newest image, unless it has been published. Without a new one it warns after
        1 s and raises `EnvironmentFailure` after 5 s."""
        image, now = self._camera.read(), time.monotonic_ns()
        if image is None or image is self._last:
            silent_s = (now - self._image_ns) / NS_PER_S
            problem = f"no new image of the camera for {silent_s:.0f} s; check its USB cable"
            if silent_s >= _FAIL_S:
                raise EnvironmentFailure(f"{problem} and start {PROG} again")
            if silent_s >= _WARN_S and self._warnings.ready(now):
                echo(f"{PROG}: warning: {problem}", error=True)
            return
        self._last, self._image_ns = image, now
        self._sequence += 1
        age = math.nan
        if image.captured_ns is not None:
            age = (now - image.captured_ns) / NS_PER_S
        self._end.send(encode_frame(DepthFrame(self._sequence, self._fov, image.depth, age)))

    def close(self) -> None:
        """Stop listening."""
        self._context.destroy(linger=0)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(DepthServerConfig, serve, argv, prog=PROG)


def serve(config: DepthServerConfig) -> None:
    """Serve until interrupted; raises `UsageError` without a serial number, `EnvironmentFailure`
    for a missing driver or camera, or a port in use."""
    fov = config.camera.vertical_fov
    with (
        closing(RealSenseDepthCamera.connect(config.camera)) as camera,
        closing(DepthServer(camera, fov, config.host, config.port)) as server,
    ):
        echo(f"{PROG}: depth at {config.host}:{server.port}; Ctrl-C ends it")
        rate = FixedRate(_POLL_HZ, MonotonicClock())
        rate.start()
        while True:
            server.step()
            rate.wait()
