"""Depth images over ZMQ: the message format, and a client that receives them.

One frame per image, published on port 5555, which LeRobot uses for cameras:

    "EGD2"  sequence u32  rows u16  columns u16  vertical field of view f32 (rad)  crc32 u32
    age f32 (s from capture to sending; NaN: unknown)
    rows x columns u16, mm, 0 invalid

The checksum covers everything after it. Little-endian.
LeRobot's own image server sends JPEG, whose compression destroys depth.
"""

from __future__ import annotations

import math
import struct
import time
import zlib
from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from egovcp.bounds import bounded, check_bounds
from egovcp.errors import EnvironmentFailure
from egovcp.rate import NS_PER_S
from egovcp.sim.config import CameraConfig
from egovcp.spec import DEPTH_COLS, DEPTH_ROWS
from egovcp_deploy.robots.base import DepthImage
from egovcp_deploy.robots.subscriber import ArrivalMonitor, Subscriber, connection_error
from egovcp_deploy.robots.wire import CAMERA_PORT, MalformedMessage

MAGIC: Final = b"EGD2"
_HEADER: Final = struct.Struct("<4sIHHfI")
_AGE: Final = struct.Struct("<f")
FRAME_BYTES: Final = _HEADER.size + _AGE.size + 2 * DEPTH_ROWS * DEPTH_COLS
SEQUENCES: Final = 2**32  # the sequence number wraps around
_MAX_AGE_S: Final = 3600.0
_MAX_MISSING: Final = 1000  # images in a row; more means that the server was restarted
_FOV_TOLERANCE: Final = math.radians(1.0)
_START: Final = "start egovcp-depth-server where the camera is, or egovcp-fake-g1 without a robot"


@dataclass(frozen=True)
class DepthFrame:
    """One depth image with the header of its message."""

    sequence: int  # number of the image, counted by the server
    vertical_fov: float  # rad
    depth: NDArray[np.uint16]  # (48, 64) mm, 0 invalid
    age_s: float = math.nan  # time from capture to sending; NaN if unknown


def encode_frame(frame: DepthFrame) -> bytes:
    """Encode a message."""
    body = _AGE.pack(frame.age_s) + frame.depth.astype("<u2").tobytes()
    rows, columns = frame.depth.shape
    sequence, crc = frame.sequence % SEQUENCES, zlib.crc32(body)
    return _HEADER.pack(MAGIC, sequence, rows, columns, frame.vertical_fov, crc) + body


def decode_frame(message: bytes) -> DepthFrame:
    """Decode a message; raises `MalformedMessage` if it is damaged, of another format or image
    size."""
    if len(message) != FRAME_BYTES:
        raise MalformedMessage(f"a depth image of {len(message)} bytes, expected {FRAME_BYTES}")
    magic, sequence, rows, columns, fov, crc = _HEADER.unpack_from(message)
    body = message[_HEADER.size :]
    if magic != MAGIC or (rows, columns) != (DEPTH_ROWS, DEPTH_COLS):
        raise MalformedMessage(
            f"{magic!r} {rows} x {columns}, expected {MAGIC!r} {DEPTH_ROWS} x {DEPTH_COLS}"
        )
    if zlib.crc32(body) != crc:
        raise MalformedMessage("a depth image with a wrong checksum")
    if not 0.0 < fov < np.pi:
        raise MalformedMessage(f"a field of view of {fov} rad")
    (age,) = _AGE.unpack_from(body)
    depth = np.frombuffer(body[_AGE.size :], "<u2").reshape(rows, columns)
    known_age = age if 0.0 <= age <= _MAX_AGE_S else math.nan
    return DepthFrame(sequence, fov, depth.astype(np.uint16), known_age)


@dataclass(frozen=True)
class ZmqCameraConfig:
    """Depth server to connect to."""

    host: str = "127.0.0.1"
    """Host of the depth server."""
    port: int = bounded(CAMERA_PORT, least=1, most=65535)
    """Its port."""
    vertical_fov: float = bounded(CameraConfig.vertical_fov, above=0, below=math.pi)
    """Required field of view of the images, rad: the policy's."""

    def __post_init__(self) -> None:
        check_bounds(self)


class ZmqDepthCamera:
    """Receives from a depth server in a thread. Call `connect` first."""

    def __init__(self, config: ZmqCameraConfig | None = None) -> None:
        self.config = config or ZmqCameraConfig()
        self._malformed = 0  # messages
        self._problem = ""  # of the last one
        self.arrivals = ArrivalMonitor(estimate_losses=False)
        """Arrivals of usable images; missing and unusable ones count as lost, but not those that
        arrived together with a newer one."""
        self._newest: DepthImage | None = None
        self._sequence: int | None = None
        self._subscriber: Subscriber | None = None

    def connect(self, timeout: float = 5.0) -> Self:
        """Wait up to ``timeout`` s for the first image; returns itself. Raises `EnvironmentFailure`
        if none arrived, or one of another field of view."""
        config = self.config
        self._subscriber = Subscriber(
            config.host, config.port, FRAME_BYTES, self._handle, self._reject
        )
        deadline = time.monotonic() + timeout
        while self._newest is None and time.monotonic() < deadline:
            time.sleep(0.005)
        if self._newest is None:
            reason = self._timeout_reason(timeout)
            self.close()
            raise EnvironmentFailure(reason)
        return self

    def _handle(self, message: bytes, time_ns: int, older: int) -> bool:
        """Process a message that arrived at ``time_ns`` with ``older`` ones, which are not used;
        whether it is a new image. Raises `MalformedMessage`."""
        frame = decode_frame(message)
        if abs(frame.vertical_fov - self.config.vertical_fov) > _FOV_TOLERANCE:
            raise MalformedMessage(
                f"a vertical field of view of {math.degrees(frame.vertical_fov):.1f} deg, "
                f"expected {math.degrees(self.config.vertical_fov):.1f}"
            )
        if frame.sequence == self._sequence:
            return False
        if self._sequence is not None:
            missing = (frame.sequence - self._sequence) % SEQUENCES - 1 - older
            if 0 < missing < _MAX_MISSING:
                self.arrivals.record_loss(time_ns, missing)
        self._sequence = frame.sequence
        age = frame.age_s
        captured_ns = None if math.isnan(age) else time_ns - round(age * NS_PER_S)
        self._newest = DepthImage(time_ns, frame.depth, captured_ns)
        self.arrivals.record_arrival(time_ns)
        return True

    def _reject(self, problem: str, time_ns: int) -> None:
        self._malformed += 1
        self._problem = problem
        self.arrivals.record_loss(time_ns)

    def read(self) -> DepthImage | None:
        """Return the newest image; its time is its time of arrival."""
        return self._newest

    def _timeout_reason(self, timeout: float) -> str:
        """Why no image arrived."""
        where = f"{self.config.host}:{self.config.port}"
        if self._malformed:
            return (
                f"{self._malformed} messages from {where}, none a usable depth image: "
                f"{self._problem}; {_START}"
            )
        if reason := connection_error(self.config.host, self.config.port):
            return f"no depth camera at {where} ({reason}); {_START}"
        return f"no depth image from {where} within {timeout:g} s, although something listens there"

    def close(self) -> None:
        """Stop the thread; may be called more than once."""
        if self._subscriber is not None:
            self._subscriber.close()
