"""ROS 2 wire format: CDR, little endian.

A message is a 4-byte encapsulation header followed by its fields in order. Every primitive
is aligned to its own size, counted from the end of that header; sequences and strings carry
a u32 length, and strings end in a zero byte that the length includes. Written by hand
because the loop has about a millisecond: a generic encoder visits each number in Python.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

_ENCAPSULATION = b"\x00\x01\x00\x00"  # plain CDR, little endian
_HEADER_BYTES = len(_ENCAPSULATION)


class Cdr:
    """Builds one message field by field; every method returns the builder."""

    def __init__(self) -> None:
        self._buffer = bytearray(_ENCAPSULATION)

    def _align(self, size: int) -> None:
        self._buffer += bytes(-(len(self._buffer) - _HEADER_BYTES) % size)

    def u8(self, value: int) -> Self:
        """One unsigned byte, or a boolean."""
        self._buffer.append(value)
        return self

    def i32(self, value: int) -> Self:
        """Signed 32-bit integer."""
        self._align(4)
        self._buffer += struct.pack("<i", value)
        return self

    def u32(self, *values: int) -> Self:
        """Unsigned 32-bit integers."""
        self._align(4)
        self._buffer += struct.pack(f"<{len(values)}I", *values)
        return self

    def string(self, text: str) -> Self:
        """UTF-8 string."""
        self._align(4)
        self._buffer += _string(text)
        return self

    def strings(self, texts: tuple[str, ...]) -> Self:
        """Sequence of strings."""
        self._align(4)
        self._buffer += _strings(texts)
        return self

    def octets(self, data: bytes) -> Self:
        """Sequence of bytes."""
        self.u32(len(data))
        self._buffer += data
        return self

    def f64(self, values: ArrayLike) -> Self:
        """Doubles of any shape, row-major, without a length: a fixed-size field."""
        array = np.asarray(values, dtype="<f8")
        if array.size:
            self._align(8)
            self._buffer += array.tobytes()
        return self

    def f64s(self, values: ArrayLike) -> Self:
        """Sequence of doubles: length, then the values."""
        array = np.asarray(values, dtype="<f8")
        return self.u32(array.size).f64(array)

    def raw(self, data: bytes) -> Self:
        """Bytes encoded before, which must fit the present alignment."""
        self._buffer += data
        return self

    def done(self) -> bytes:
        """The finished message."""
        return bytes(self._buffer)


@lru_cache(maxsize=1024)
def _string(text: str) -> bytes:
    """A string from an aligned start; names repeat in every tick, so their bytes are kept."""
    data = text.encode()
    return struct.pack("<I", len(data) + 1) + data + b"\x00"


@lru_cache(maxsize=64)
def _strings(texts: tuple[str, ...]) -> bytes:
    """A sequence of strings from an aligned start."""
    cdr = Cdr().u32(len(texts))
    for text in texts:
        cdr.string(text)
    return cdr.done()[_HEADER_BYTES:]
