"""`egovcp-depth-server`: gives the depth camera of this machine to a planner on another."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import zmq

from egovcp.bounds import bounded
from egovcp.cli import run_command
from egovcp.errors import EnvironmentFailure
from egovcp.rate import NS_PER_S, FixedRate, MonotonicClock
from egovcp.terminal import echo
from egovcp_deploy.robots.body import Eye, Picture
from egovcp_deploy.robots.depth_wire import WirePicture, encode_picture
from egovcp_deploy.robots.realsense_eye import RealSenseEye, RealSenseEyeConfig
from egovcp_deploy.robots.wire import CAMERA_PORT

PROG: Final = "egovcp-depth-server"
_LOOK_HZ: Final = 200  # how often the camera is asked for something new


@dataclass(frozen=True)
class DepthServerConfig:
    """Publish the pictures of a RealSense depth camera, as small as the policy wants them.

    Untested on hardware.
    """

    camera: RealSenseEyeConfig = field(default_factory=RealSenseEyeConfig)
    """The camera."""
    host: str = "127.0.0.1"
    """Interface to listen on; the loopback lets nobody else in, the address of the robot's own
    network its machines."""
    port: int = bounded(CAMERA_PORT, least=0, most=65535)
    """Port."""


class DepthServer:
    """Publishes an `Eye`, each picture once.

    Raises:
        EnvironmentFailure: the port is in use.
    """

    def __init__(self, eye: Eye, vertical_fov: float, host: str, port: int) -> None:
        self._eye, self._fov = eye, vertical_fov
        self._last: Picture | None = None
        self._sequence = 0
        self._context = zmq.Context()
        self._end = self._context.socket(zmq.PUB)
        self._end.setsockopt(zmq.LINGER, 0)
        self._end.setsockopt(zmq.SNDHWM, 2)
        try:
            self._end.bind(f"tcp://{host}:{port or '*'}")
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise EnvironmentFailure(
                f"cannot listen at {host}:{port}: {error.strerror}; end what uses the port, or "
                "choose another"
            ) from error

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._end.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])

    def step(self) -> None:
        """Publish the newest picture, unless it has been."""
        picture = self._eye.read()
        if picture is None or picture is self._last:
            return
        self._last = picture
        self._sequence += 1
        taken_ns = picture.taken_ns
        age = math.nan if taken_ns is None else (time.monotonic_ns() - taken_ns) / NS_PER_S
        sent = WirePicture(self._sequence, self._fov, picture.depth, age)
        self._end.send(encode_picture(sent))

    def close(self) -> None:
        """Stop listening."""
        self._context.destroy(linger=0)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(DepthServerConfig, serve, argv, prog=PROG)


def serve(config: DepthServerConfig) -> None:
    """Serve until interrupted.

    Raises:
        EnvironmentFailure: no driver, no such camera, or a port in use.
    """
    eye = RealSenseEye.connect(config.camera)
    try:
        server = DepthServer(eye, config.camera.vertical_fov, config.host, config.port)
        echo(f"{PROG}: depth at {config.host}:{server.port}; Ctrl-C ends it")
        rate = FixedRate(_LOOK_HZ, MonotonicClock())
        rate.start()
        while True:
            server.step()
            rate.wait()
    finally:
        eye.close()


if __name__ == "__main__":
    raise SystemExit(main())
