"""Depth pictures on the wire: one ZMQ frame each, published on LeRobot's port for cameras, 5555.

    "EGD2"  sequence u32  rows u16  columns u16  vertical field of view f32 (rad)  crc32 u32
    age f32 (s since it was captured, when it is sent; not-a-number: unknown)
    rows x columns u16, mm, 0 invalid

The checksum covers all that follows it. "EGD1", of older servers, is the same without the age.
Little-endian. LeRobot's own image server sends JPEG, which depth does not survive.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.spec import DEPTH_COLS, DEPTH_ROWS
from egovcp_deploy.robots.wire import Garbled

MAGIC: Final = b"EGD2"
_MAGIC_WITHOUT_AGE: Final = b"EGD1"
_HEADER: Final = struct.Struct("<4sIHHfI")
_AGE: Final = struct.Struct("<f")
_PIXELS: Final = 2 * DEPTH_ROWS * DEPTH_COLS  # bytes
PICTURE_BYTES: Final = _HEADER.size + _AGE.size + _PIXELS
SEQUENCES: Final = 2**32  # the sequence number wraps around
_OLDEST_S: Final = 3600.0


@dataclass(frozen=True)
class WirePicture:
    """One picture as the server took it."""

    sequence: int
    """Counts the server's pictures."""
    vertical_fov: float
    """rad."""
    depth: NDArray[np.uint16]
    """(48, 64) mm, 0 invalid."""
    age_s: float = math.nan
    """Since it was captured, when it was sent; not-a-number: the server does not know."""


def encode_picture(picture: WirePicture) -> bytes:
    """The frame."""
    body = _AGE.pack(picture.age_s) + picture.depth.astype("<u2").tobytes()
    rows, columns = picture.depth.shape
    sequence, crc = picture.sequence % SEQUENCES, zlib.crc32(body)
    return _HEADER.pack(MAGIC, sequence, rows, columns, picture.vertical_fov, crc) + body


def decode_picture(frame: bytes) -> WirePicture:
    """The inverse of `encode_picture`.

    Raises:
        Garbled: it is none, or of another size.
    """
    expected = PICTURE_BYTES - (_AGE.size if frame.startswith(_MAGIC_WITHOUT_AGE) else 0)
    if len(frame) != expected:
        raise Garbled(f"a picture of {len(frame)} bytes, expected {expected}")
    magic, sequence, rows, columns, fov, crc = _HEADER.unpack_from(frame)
    body = frame[_HEADER.size :]
    if magic not in (MAGIC, _MAGIC_WITHOUT_AGE) or (rows, columns) != (DEPTH_ROWS, DEPTH_COLS):
        raise Garbled(f"{magic!r} {rows} x {columns}, expected {MAGIC!r} {DEPTH_ROWS} x 64")
    if zlib.crc32(body) != crc:
        raise Garbled("a picture whose checksum is wrong")
    if not 0.0 < fov < np.pi:
        raise Garbled(f"a field of view of {fov} rad")
    age = _AGE.unpack_from(body)[0] if magic == MAGIC else math.nan
    depth = np.frombuffer(body[-_PIXELS:], "<u2").reshape(rows, columns)
    known = age if 0.0 <= age <= _OLDEST_S else math.nan
    return WirePicture(sequence, fov, depth.astype(np.uint16), known)
