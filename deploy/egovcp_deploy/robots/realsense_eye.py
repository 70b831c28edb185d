"""An `Eye` that is a RealSense depth camera on this machine, through LeRobot's driver.

Untested on hardware: the tests run against a camera object that behaves as LeRobot's does.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, Final, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from egovcp.bounds import bounded
from egovcp.errors import EnvironmentFailure
from egovcp.packages import require_packages
from egovcp.sim.config import CameraConfig
from egovcp_deploy.robots.arrivals import Arrivals
from egovcp_deploy.robots.body import Picture
from egovcp_deploy.robots.resample import Intrinsics, Resampler

_LEAST_COVERAGE: Final = 0.9
_OLDEST_MS: Final = 10_000  # the age of a picture is the caller's business; this only peeks


@dataclass(frozen=True)
class RealSenseEyeConfig:
    """Which camera, and how it is run."""

    serial: str = ""
    """Serial number, or name if there is only one of it; lerobot-find-cameras realsense lists
    them."""
    width: int = bounded(848, least=1, most=8192)
    """Columns of its depth; the stereo of a D435i is best at 848 x 480."""
    height: int = bounded(480, least=1, most=8192)
    """Rows of its depth."""
    fps: int = bounded(60, least=1, most=1000)
    """Pictures per second."""
    vertical_fov: float = bounded(CameraConfig.vertical_fov, above=0, below=math.pi)
    """Field of view that the policy knows, rad; the camera's own must not be much smaller."""


class DepthCamera(Protocol):
    """The part of LeRobot's ``RealSenseCamera`` that is used."""

    def read_latest_depth(self, max_age_ms: int = 500) -> NDArray[np.uint16]:
        """(H, W, 1) mm; raises before the first picture and when the newest is too old."""
        ...

    def disconnect(self) -> None:
        """Stop the camera."""
        ...


class RealSenseEye:
    """Reads LeRobot's camera, whose own thread waits for the hardware.

    Args:
        camera: connected.
        intrinsics: of its depth pictures.
        vertical_fov: of the policy's pictures, rad.

    Raises:
        EnvironmentFailure: it sees too little of what the policy expects to see.
    """

    def __init__(self, camera: DepthCamera, intrinsics: Intrinsics, vertical_fov: float) -> None:
        self._camera: DepthCamera | None = camera
        self._resample = Resampler(intrinsics, vertical_fov)
        if self._resample.coverage < _LEAST_COVERAGE:
            raise EnvironmentFailure(
                f"the camera sees {self._resample.coverage:.0%} of what the policy expects to see, "
                f"expected at least {_LEAST_COVERAGE:.0%}; choose a wider mode of it, or a policy "
                "that was trained with its field of view"
            )
        self._seen: NDArray[np.uint16] | None = None
        self._newest: Picture | None = None
        self.problem = ""
        """Why the last `read` found nothing new, in the driver's words."""
        self.arrivals = Arrivals(numbered=True)  # what two reads skip is not lost
        """Of pictures, as they are read."""

    @classmethod
    def connect(cls, config: RealSenseEyeConfig) -> Self:
        """Start the camera.

        Raises:
            EnvironmentFailure: there is no driver, or no such camera.
        """
        camera = _start(config)
        try:
            return cls(camera, _intrinsics(camera), config.vertical_fov)
        except BaseException:
            camera.disconnect()
            raise

    def read(self) -> Picture | None:
        """The newest picture, resampled once; its time is when it was first read or taken."""
        if self._camera is None:
            return self._newest
        now_ns = time.monotonic_ns()
        taken_ns = self._taken_ns(now_ns)  # before the picture: it may be of the one before
        try:
            raw = self._camera.read_latest_depth(max_age_ms=_OLDEST_MS)
        except (RuntimeError, TimeoutError, ConnectionError) as error:
            self.problem = str(error)
            return self._newest
        if raw is not self._seen:
            self._seen = raw
            time_ns = now_ns if taken_ns is None else taken_ns
            self._newest = Picture(time_ns, self._resample(raw), taken_ns)
            self.arrivals.arrived(time_ns)
        return self._newest

    def _taken_ns(self, now_ns: int) -> int | None:
        """When the driver received its newest picture, never later than now; None: it does not
        say. LeRobot's driver gives no time of exposure."""
        stamp: float | None = getattr(self._camera, "latest_timestamp", None)  # perf_counter, s
        if stamp is None:
            return None
        return now_ns - max(0, time.perf_counter_ns() - round(stamp * 1e9))

    def close(self) -> None:
        """Stop the camera; further calls do nothing."""
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.disconnect()


def require_realsense() -> None:
    """Raise `MissingPackage` where LeRobot's RealSense camera is not installed."""
    require_packages("egovcp-deploy", "the camera", "lerobot", "pyrealsense2")


def _start(config: RealSenseEyeConfig) -> Any:
    """LeRobot's camera, connected."""
    if not config.serial:
        raise EnvironmentFailure(
            "no camera was named; give its serial number, which lerobot-find-cameras realsense "
            "prints"
        )
    require_realsense()
    from lerobot.cameras.realsense import RealSenseCamera, RealSenseCameraConfig

    wanted = RealSenseCameraConfig(
        serial_number_or_name=config.serial,
        fps=config.fps,
        width=config.width,
        height=config.height,
        use_rgb=False,
        use_depth=True,
    )
    try:
        camera = RealSenseCamera(wanted)
        camera.connect()
    except (ConnectionError, RuntimeError, TimeoutError, ValueError) as error:
        raise EnvironmentFailure(
            f"the camera {config.serial} cannot be used: {error}; see lerobot-find-cameras "
            "realsense, and its USB 3 cable"
        ) from error
    return camera


def _intrinsics(camera: Any) -> Intrinsics:
    """What the camera says of its depth stream."""
    import pyrealsense2 as rs

    stream = camera.rs_profile.get_stream(rs.stream.depth).as_video_stream_profile()
    found = stream.get_intrinsics()
    return Intrinsics(found.width, found.height, found.fx, found.fy, found.ppx, found.ppy)
