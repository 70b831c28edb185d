"""The operator's remote control: 40 bytes that the robot relays with every reading.

    0-1 header   2-3 buttons, a bit each   4 lx   8 rx   12 ry   16 L2   20 ly   24-39 unused

Numbers are little-endian float32 in [-1, 1]. The order of the buttons is the one that
``lerobot.teleoperators.unitree_g1`` reads; the offsets are those of Unitree's SDK. Untested on
hardware.
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
#: vx, vy (m/s) and yaw rate (rad/s) that a stick pushed all the way asks for.
FULL_STICK: Final = (0.6, 0.2, 0.5)

_LAYOUT: Final = struct.Struct("<2sHfffff16x")
_HEADER: Final = b"\x55\x51"
_OVERSHOOT: Final = 1.05  # a worn stick may read a little beyond its end


@dataclass(frozen=True)
class Remote:
    """Sticks and buttons."""

    lx: float = 0.0
    """Left stick, 1 is right."""
    ly: float = 0.0
    """Left stick, 1 is forward."""
    rx: float = 0.0
    """Right stick, 1 is right."""
    ry: float = 0.0
    """Right stick, 1 is forward."""
    pressed: frozenset[str] = frozenset()
    """Which of `BUTTONS` are held down."""

    @classmethod
    def parse(cls, raw: bytes) -> Remote | None:
        """What the remote control says; None: the robot has none, or the bytes make no sense."""
        if len(raw) != REMOTE_BYTES:
            return None
        _, bits, lx, rx, ry, _, ly = _LAYOUT.unpack(raw)
        if not all(abs(axis) <= _OVERSHOOT for axis in (lx, ly, rx, ry)):  # nor NaN
            return None
        pressed = frozenset(name for i, name in enumerate(BUTTONS) if bits >> i & 1)
        return cls(lx, ly, rx, ry, pressed)

    def to_bytes(self) -> bytes:
        """The inverse of `parse`, to single precision."""
        bits = sum(1 << i for i, name in enumerate(BUTTONS) if name in self.pressed)
        return _LAYOUT.pack(_HEADER, bits, self.lx, self.rx, self.ry, 0.0, self.ly)

    @property
    def velocity(self) -> NDArray[np.float64]:
        """(3,) wish for vx, vy (m/s, left positive) and yaw rate (rad/s, left positive)."""
        return np.array([self.ly, -self.lx, -self.rx]) * FULL_STICK

    @classmethod
    def asking_for(
        cls, velocity: NDArray[np.floating], pressed: frozenset[str] = frozenset()
    ) -> Remote:
        """Sticks that ask for ``velocity`` (3,), as far as they go, and these buttons."""
        forward, left, turn = np.clip(np.asarray(velocity) / FULL_STICK, -1.0, 1.0).tolist()
        return cls(lx=-left, ly=forward, rx=-turn, pressed=pressed)
