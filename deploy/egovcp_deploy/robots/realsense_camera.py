"""A RealSense depth camera on this machine, through LeRobot's driver.

`DepthResampler` converts its images to those of the policy: crop, resample, clip. Untested on
hardware: the tests use a camera object that behaves as LeRobot's does.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from egovcp.bounds import bounded
from egovcp.errors import EnvironmentFailure, UsageError
from egovcp.packages import require_packages
from egovcp.robot.geometry import focal_length
from egovcp.sim.config import CameraConfig
from egovcp.spec import DEPTH_COLS, DEPTH_MAX_M, DEPTH_MIN_M, DEPTH_ROWS
from egovcp_deploy.robots.base import DepthImage
from egovcp_deploy.robots.subscriber import ArrivalMonitor

_MIN_COVERAGE: Final = 0.9
_MAX_AGE_MS: Final = 10_000  # the caller judges the age of an image

_MIN_MM: Final = math.ceil(DEPTH_MIN_M * 1000)
_MAX_MM: Final = math.floor(DEPTH_MAX_M * 1000)
_INVALID: Final = np.uint16(65535)  # sorts after every depth
_SAMPLE_SPACING: Final = 1 / 3  # of an output pixel
_MIN_VALID: Final = 5  # of nine samples


@dataclass(frozen=True)
class RealSenseConfig:
    """RealSense camera and its mode."""

    serial: str = ""
    """Serial number, or name if it is unique; lerobot-find-cameras realsense lists them.
    Required."""
    width: int = bounded(848, least=1, most=8192)
    """Columns of the depth image; the stereo of a D435i is best at 848 x 480."""
    height: int = bounded(480, least=1, most=8192)
    """Rows of the depth image."""
    fps: int = bounded(60, least=1, most=1000)
    """Images per second."""
    vertical_fov: float = bounded(CameraConfig.vertical_fov, above=0, below=math.pi)
    """Field of view of the policy's images, rad; the camera's must not be much smaller."""


class DepthResampler:
    """Resamples images of one camera to (48, 64), with ``vertical_fov`` rad; ``camera`` is its
    ``pyrealsense2.intrinsics`` without distortion, as the depth of a D400 has.

    Output pixel (i, j) looks along ((j - 31.5) / f, (i - 23.5) / f, 1), right, down and forward,
    with f = 24 / tan(fov / 2), as in the simulated camera. Depth is planar in both. Each pixel is
    the lower median of the valid ones among nine input pixels around its ray, so it is always a
    measured depth: surfaces are never blended. With fewer than five valid ones it is invalid.
    """

    def __init__(self, camera: Any, vertical_fov: float) -> None:
        focal = focal_length(vertical_fov)
        offsets = np.array([-_SAMPLE_SPACING, 0.0, _SAMPLE_SPACING])
        down = (np.arange(DEPTH_ROWS)[:, None] - (DEPTH_ROWS - 1) / 2 + offsets) / focal
        right = (np.arange(DEPTH_COLS)[:, None] - (DEPTH_COLS - 1) / 2 + offsets) / focal
        rows = np.rint(camera.fy * down + camera.ppy).astype(np.intp)  # (48, 3)
        columns = np.rint(camera.fx * right + camera.ppx).astype(np.intp)  # (64, 3)
        in_rows = (rows >= 0) & (rows < camera.height)
        in_columns = (columns >= 0) & (columns < camera.width)
        index = rows[:, None, :, None] * camera.width + columns[None, :, None, :]
        inside = in_rows[:, None, :, None] & in_columns[None, :, None, :]
        outside = camera.width * camera.height  # index of an extra pixel that is always invalid
        self._index = np.where(inside, index, outside).reshape(-1, 9)  # (3072, 9)
        self._shape = (camera.height, camera.width)
        self._flat = np.full(outside + 1, _INVALID, np.uint16)

    @property
    def coverage(self) -> float:
        """Share of the output image that the camera sees."""
        return float((self._index < len(self._flat) - 1).mean())

    def __call__(self, depth: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """(height, width) or (height, width, 1) mm, 0 invalid -> (48, 64) mm, 0 invalid; raises
        `ValueError` for another shape."""
        if depth.shape[:2] != self._shape or depth.size != self._shape[0] * self._shape[1]:
            raise ValueError(f"depth image has shape {depth.shape}, expected {self._shape}")
        self._flat[:-1] = depth.reshape(-1)
        samples = self._flat[self._index]
        valid = (samples >= _MIN_MM) & (samples <= _MAX_MM)
        samples[~valid] = _INVALID
        samples.sort(axis=1)
        count = valid.sum(axis=1)
        median = samples[np.arange(len(samples)), np.maximum(count - 1, 0) // 2]
        resampled = np.where(count >= _MIN_VALID, median, np.uint16(0))
        return np.asarray(resampled.reshape(DEPTH_ROWS, DEPTH_COLS), np.uint16)


class RealSenseDepthCamera:
    """Reads LeRobot's ``RealSenseCamera``, which is connected and has its own thread; raises
    `EnvironmentFailure` if it covers less than 90 % of the policy's field of view."""

    def __init__(self, driver: Any, intrinsics: Any, vertical_fov: float) -> None:
        self._driver: Any | None = driver
        self._resample = DepthResampler(intrinsics, vertical_fov)
        if self._resample.coverage < _MIN_COVERAGE:
            raise EnvironmentFailure(
                f"the camera covers {self._resample.coverage:.0%} of the policy's field of view, "
                f"expected at least {_MIN_COVERAGE:.0%}; choose a wider mode (width, height), or a "
                "policy trained with a smaller field of view, and set vertical_fov to that"
            )
        self._raw: NDArray[np.uint16] | None = None
        self._newest: DepthImage | None = None
        # Images between two reads are not lost.
        self.arrivals = ArrivalMonitor(estimate_losses=False)
        """Arrivals of the images that were read."""

    @classmethod
    def connect(cls, config: RealSenseConfig) -> Self:
        """Start the camera; raises as `require_realsense`, and `EnvironmentFailure` if there is no
        such camera."""
        require_realsense(config)
        import pyrealsense2 as rs
        from lerobot.cameras.realsense import RealSenseCamera, RealSenseCameraConfig

        lerobot_config = RealSenseCameraConfig(
            serial_number_or_name=config.serial,
            fps=config.fps,
            width=config.width,
            height=config.height,
            use_rgb=False,
            use_depth=True,
        )
        try:
            driver = RealSenseCamera(lerobot_config)
            driver.connect()
        except (ConnectionError, RuntimeError, TimeoutError, ValueError) as error:
            raise EnvironmentFailure(
                f"the camera {config.serial} cannot be used: {error}; run lerobot-find-cameras "
                "realsense and check the USB 3 cable"
            ) from error
        try:
            require_millimetres(driver.rs_profile)
            stream = driver.rs_profile.get_stream(rs.stream.depth).as_video_stream_profile()
            return cls(driver, stream.get_intrinsics(), config.vertical_fov)
        except BaseException:
            driver.disconnect()
            raise

    def read(self) -> DepthImage | None:
        """Return the newest image, stamped with the driver's receive time, or the call time if
        unknown. None before the first image."""
        if self._driver is None:
            return self._newest
        now_ns = time.monotonic_ns()
        # When the driver received its newest image; it gives no time of exposure. It is read before
        # the image: too old rather than too new.
        stamp: float | None = getattr(self._driver, "latest_timestamp", None)  # perf_counter, s
        captured_ns = None
        if stamp is not None:
            captured_ns = now_ns - max(0, time.perf_counter_ns() - round(stamp * 1e9))
        try:
            raw = self._driver.read_latest_depth(max_age_ms=_MAX_AGE_MS)
        except (RuntimeError, TimeoutError, ConnectionError):
            return self._newest
        if raw is not self._raw:
            self._raw = raw
            time_ns = now_ns if captured_ns is None else captured_ns
            self._newest = DepthImage(time_ns, self._resample(raw), captured_ns)
            self.arrivals.record_arrival(time_ns)
        return self._newest

    def close(self) -> None:
        """Stop the camera; may be called more than once."""
        driver, self._driver = self._driver, None
        if driver is not None:
            driver.disconnect()


def require_millimetres(profile: Any) -> None:
    """Raise `EnvironmentFailure` unless the camera's depth is in mm, as that of a D435i is."""
    scale = float(profile.get_device().first_depth_sensor().get_depth_scale())  # m
    if not math.isclose(scale, 1e-3, rel_tol=1e-3):
        raise EnvironmentFailure(
            f"the camera reports depth in units of {scale * 1000:g} mm, expected 1 mm; set its "
            "depth units to 1000 um"
        )


def require_realsense(config: RealSenseConfig) -> None:
    """Raise `UsageError` without a serial number, and `MissingPackage` if LeRobot's RealSense
    camera is not installed."""
    if not config.serial:
        raise UsageError(
            "the serial number of the RealSense camera is missing; give one that "
            "lerobot-find-cameras realsense lists as --robot.camera.realsense.serial, or "
            "egovcp-depth-server --camera.serial"
        )
    require_packages("egovcp-deploy", "the camera", "lerobot", "pyrealsense2")
