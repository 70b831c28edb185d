"""Message of the operator's remote control: 40 bytes that the robot sends with every reading.

    0-1 header   2-3 buttons, a bit each   4 lx   8 rx   12 ry   16 L2   20 ly   24-39 unused

Numbers are little-endian float32 in [-1, 1]. The order of the buttons is that of
``lerobot.teleoperators.unitree_g1``; the offsets are those of Unitree's SDK. Untested on hardware.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

REMOTE_BYTES: Final = 40
#: Bit 0 first. R1 and L1 are LeRobot's RB and LB, R2 and L2 its RT and LT.
BUTTONS: Final = (
    *("R1", "L1", "start", "select", "R2", "L2", "F1", "F2"),
    *("A", "B", "X", "Y", "up", "right", "down", "left"),
)
#: vx, vy (m/s) and yaw rate (rad/s) at full deflection of the sticks.
FULL_STICK: Final = (0.6, 0.2, 0.5)

_LAYOUT: Final = struct.Struct("<2sHfffff16x")
_HEADER: Final = b"\x55\x51"
_MAX_AXIS: Final = 1.05  # a worn stick may exceed 1


@dataclass(frozen=True)
class RemoteControl:
    """Sticks and buttons."""

    lx: float = 0.0  # left stick, 1 is right
    ly: float = 0.0  # left stick, 1 is forward
    rx: float = 0.0  # right stick, 1 is right
    ry: float = 0.0  # right stick, 1 is forward
    pressed: frozenset[str] = frozenset()  # pressed buttons, of `BUTTONS`

    @classmethod
    def parse(cls, raw: bytes) -> RemoteControl | None:
        """Decode the message; None if there is no remote control or the bytes are invalid."""
        if len(raw) != REMOTE_BYTES:
            return None
        _, bits, lx, rx, ry, _, ly = _LAYOUT.unpack(raw)
        if not all(abs(axis) <= _MAX_AXIS for axis in (lx, ly, rx, ry)):  # also rejects NaN
            return None
        pressed = frozenset(name for i, name in enumerate(BUTTONS) if bits >> i & 1)
        return cls(lx, ly, rx, ry, pressed)

    def to_bytes(self) -> bytes:
        """Encode the message, in single precision."""
        bits = sum(1 << i for i, name in enumerate(BUTTONS) if name in self.pressed)
        return _LAYOUT.pack(_HEADER, bits, self.lx, self.rx, self.ry, 0.0, self.ly)

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(3,) requested vx, vy (m/s, left positive) and yaw rate (rad/s, left positive)."""
        return np.array([self.ly, -self.lx, -self.rx]) * FULL_STICK

    @classmethod
    def from_velocity(
        cls, velocity: NDArray[np.floating], pressed: frozenset[str] = frozenset()
    ) -> RemoteControl:
        """Sticks that request ``velocity`` (3,), limited to full deflection."""
        forward, left, turn = np.clip(np.asarray(velocity) / FULL_STICK, -1.0, 1.0).tolist()
        return cls(lx=-left, ly=forward, rx=-turn, pressed=pressed)
