"""An `Eye` at the other end of a wire: pictures of `depth_wire` over ZMQ."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Final

from egovcp.bounds import bounded, check_bounds
from egovcp.errors import EnvironmentFailure
from egovcp.rate import NS_PER_S
from egovcp.sim.config import CameraConfig
from egovcp_deploy.robots.arrivals import Arrivals
from egovcp_deploy.robots.body import Picture
from egovcp_deploy.robots.depth_wire import PICTURE_BYTES, SEQUENCES, decode_picture
from egovcp_deploy.robots.listener import Listener, probe
from egovcp_deploy.robots.wire import CAMERA_PORT, Garbled

_MOST_MISSING: Final = 1000  # pictures in a row; more is another server
_FOV_SLACK: Final = math.radians(1.0)
_START: Final = "start egovcp-depth-server where the camera is, or egovcp-fake-g1 without a robot"


@dataclass(frozen=True)
class ZmqEyeConfig:
    """Where pictures come from."""

    host: str = "127.0.0.1"
    """Machine of the depth server."""
    port: int = bounded(CAMERA_PORT, least=1, most=65535)
    """Its port."""
    vertical_fov: float = bounded(CameraConfig.vertical_fov, above=0, below=math.pi)
    """Field of view that the pictures must have, rad: the policy's."""

    def __post_init__(self) -> None:
        check_bounds(self)


class ZmqEye:
    """Receives in a thread of its own; `read` looks at the newest. Call `connect` first."""

    def __init__(self, config: ZmqEyeConfig | None = None) -> None:
        self.config = config or ZmqEyeConfig()
        self.pictures = self.repeated = self.garbled = 0
        self.problem = ""
        """What was wrong with the last message that was dropped."""
        self.arrivals = Arrivals(numbered=True)
        """Of usable pictures; missing and unusable ones count as lost."""
        self._newest: Picture | None = None
        self._sequence: int | None = None
        self._listener: Listener | None = None

    def connect(self, timeout: float = 5.0) -> None:
        """Wait for the first picture.

        Raises:
            EnvironmentFailure: none came within ``timeout`` s, or of another field of view.
        """
        config = self.config
        self._listener = Listener(config.host, config.port, PICTURE_BYTES, self._take)
        deadline = time.monotonic() + timeout
        while self._newest is None and time.monotonic() < deadline:
            time.sleep(0.005)
        if self._newest is None:
            diagnosis = self._diagnosis(timeout)
            self.close()
            raise EnvironmentFailure(diagnosis)

    def _take(self, frame: bytes, time_ns: int) -> bool:
        """A message that arrived at ``time_ns``; whether it is a new picture."""
        try:
            picture = decode_picture(frame)
            if abs(picture.vertical_fov - self.config.vertical_fov) > _FOV_SLACK:
                raise Garbled(
                    f"a vertical field of view of {math.degrees(picture.vertical_fov):.1f} deg, "
                    f"expected {math.degrees(self.config.vertical_fov):.1f}"
                )
        except Garbled as error:
            self.garbled += 1
            self.problem = str(error)
            self.arrivals.lost(time_ns)
            return False
        if picture.sequence == self._sequence:
            self.repeated += 1
            return False
        self.pictures += 1
        self._count_missing(picture.sequence, time_ns)
        self._sequence = picture.sequence
        age = picture.age_s
        taken_ns = None if math.isnan(age) else time_ns - round(age * NS_PER_S)
        self._newest = Picture(time_ns, picture.depth, taken_ns)
        self.arrivals.arrived(time_ns)
        return True

    def _count_missing(self, sequence: int, time_ns: int) -> None:
        """A server that was started again begins anew, and has lost none."""
        if self._sequence is None:
            return
        missing = (sequence - self._sequence) % SEQUENCES - 1
        if 0 < missing < _MOST_MISSING:
            self.arrivals.lost(time_ns, missing)

    def read(self) -> Picture | None:
        """The newest picture; its time is that of its arrival, whenever it is read."""
        return self._newest

    def _diagnosis(self, timeout: float) -> str:
        config = self.config
        where = f"{config.host}:{config.port}"
        if self.garbled:
            return (
                f"{self.garbled} messages from {where}, none a picture that we can use: "
                f"{self.problem}; {_START}"
            )
        if reason := probe(config.host, config.port):
            return f"no depth camera at {where} ({reason}); {_START}"
        return f"no picture from {where} within {timeout:g} s, although something listens there"

    def close(self) -> None:
        """End the thread; further calls do nothing."""
        if self._listener is not None:
            self._listener.close()
