"""Depth pictures on the wire: one ZMQ frame each, published on LeRobot's port for cameras, 5555.

    "EGD1"  sequence u32  rows u16  columns u16  vertical field of view f32 (rad)  crc32 u32
    rows x columns u16, mm, 0 invalid

Little-endian. LeRobot's own image server sends JPEG, which depth does not survive.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.spec import DEPTH_COLS, DEPTH_ROWS
from egovcp_deploy.robots.wire import Garbled

MAGIC: Final = b"EGD1"
_HEADER: Final = struct.Struct("<4sIHHfI")
PICTURE_BYTES: Final = _HEADER.size + 2 * DEPTH_ROWS * DEPTH_COLS


@dataclass(frozen=True)
class WirePicture:
    """One picture as the server took it."""

    sequence: int
    """Counts the server's pictures."""
    vertical_fov: float
    """rad."""
    depth: NDArray[np.uint16]
    """(48, 64) mm, 0 invalid."""


def encode_picture(picture: WirePicture) -> bytes:
    """The frame."""
    pixels = picture.depth.astype("<u2").tobytes()
    rows, columns = picture.depth.shape
    sequence, crc = picture.sequence % 2**32, zlib.crc32(pixels)
    return _HEADER.pack(MAGIC, sequence, rows, columns, picture.vertical_fov, crc) + pixels


def decode_picture(frame: bytes) -> WirePicture:
    """The inverse of `encode_picture`.

    Raises:
        Garbled: it is none, or of another size.
    """
    if len(frame) != PICTURE_BYTES:
        raise Garbled(f"a picture of {len(frame)} bytes, expected {PICTURE_BYTES}")
    magic, sequence, rows, columns, fov, crc = _HEADER.unpack_from(frame)
    pixels = frame[_HEADER.size :]
    if magic != MAGIC or (rows, columns) != (DEPTH_ROWS, DEPTH_COLS):
        raise Garbled(f"{magic!r} {rows} x {columns}, expected {MAGIC!r} {DEPTH_ROWS} x 64")
    if zlib.crc32(pixels) != crc:
        raise Garbled("a picture whose checksum is wrong")
    if not 0.0 < fov < np.pi:
        raise Garbled(f"a field of view of {fov} rad")
    depth = np.frombuffer(pixels, "<u2").reshape(rows, columns)
    return WirePicture(sequence, fov, depth.astype(np.uint16))
