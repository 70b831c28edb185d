"""Depth frames as raw one-strip TIFF blobs, a whole episode at a time.

LeRobot stores a depth frame as an uncompressed little-endian TIFF (what Pillow writes
for a 16-bit image): one image file directory of nine entries, then the pixels. Every
frame of a dataset has the same 122-byte header, so encoding is one broadcast copy and
decoding is a comparison of headers and one reshape; any other TIFF goes through Pillow.
"""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egovcp.errors import DataError


@cache
def header(rows: int, cols: int) -> bytes:
    """The bytes before the pixels of a (rows, cols) uint16 TIFF (TIFF 6.0, section 8)."""
    entries = {  # tag -> type (3: uint16, 4: uint32) and value
        256: (4, cols),
        257: (4, rows),
        258: (3, 16),  # bits per sample
        259: (3, 1),  # no compression
        262: (3, 1),  # black is zero
        273: (4, 122),  # offset of the pixels, the length of this header
        278: (4, rows),  # rows per strip
        279: (4, 2 * rows * cols),  # bytes of the strip
        284: (3, 1),  # one plane
    }
    directory = b"".join(
        struct.pack("<HHII", tag, kind, 1, v) for tag, (kind, v) in entries.items()
    )
    return struct.pack("<2sHIH", b"II", 42, 8, len(entries)) + directory + bytes(4)


def encode(depth: NDArray[np.uint16]) -> pa.BinaryArray:
    """Depth ``(T, H, W)`` uint16 -> ``T`` TIFF blobs."""
    frames, rows, cols = depth.shape
    head = np.frombuffer(header(rows, cols), dtype=np.uint8)
    pixels = np.ascontiguousarray(depth, dtype="<u2").reshape(frames, -1).view(np.uint8)
    blobs = np.empty((frames, head.size + pixels.shape[1]), dtype=np.uint8)
    blobs[:, : head.size] = head
    blobs[:, head.size :] = pixels
    offsets = np.arange(frames + 1, dtype=np.int32) * np.int32(blobs.shape[1])
    buffers = [None, pa.py_buffer(offsets), pa.py_buffer(blobs)]
    return pa.Array.from_buffers(pa.binary(), frames, buffers)


def decode(blobs: pa.BinaryArray, rows: int, cols: int) -> NDArray[np.uint16]:
    """``T`` TIFF blobs -> depth ``(T, rows, cols)`` uint16; fast for the layout of `encode`."""
    if blobs.null_count:
        empty = int(np.argmax(blobs.is_null().to_numpy(zero_copy_only=False)))
        raise DataError.without_place("its depth image is empty", empty)
    raw = _fixed_size_bytes(blobs, len(header(rows, cols)) + 2 * rows * cols)
    if raw is not None:
        head = np.frombuffer(header(rows, cols), dtype=np.uint8)
        if np.array_equal(raw[:, : head.size], np.broadcast_to(head, (len(raw), head.size))):
            pixels = np.ascontiguousarray(raw[:, head.size :])
            return pixels.view("<u2").reshape(-1, rows, cols)
    return np.stack([_decode_any(blob.as_py(), i, rows, cols) for i, blob in enumerate(blobs)])


def _fixed_size_bytes(blobs: pa.BinaryArray, size: int) -> NDArray[np.uint8] | None:
    """The blobs as ``(T, size)`` bytes without a copy; None if any has another length."""
    _, offset_buffer, data = blobs.buffers()
    offsets = np.frombuffer(offset_buffer, dtype=np.int32)
    offsets = offsets[blobs.offset : blobs.offset + len(blobs) + 1]
    if data is None or not np.all(np.diff(offsets) == size):
        return None
    window = np.frombuffer(data, dtype=np.uint8)[offsets[0] : offsets[-1]]
    return window.reshape(len(blobs), size)


def _decode_any(blob: bytes, frame: int, rows: int, cols: int) -> NDArray[np.uint16]:
    with open_image(blob, "its depth image", frame, "a TIFF", formats=("TIFF",)) as image:
        found = f"{image.mode} {image.height}x{image.width}"
        if image.mode.startswith("I;16") and image.size == (cols, rows):
            return np.asarray(image).astype(np.uint16)
    raise DataError.without_place(
        f"its depth image is {found}, expected uint16 {rows}x{cols}", frame
    )


@contextmanager
def open_image(
    blob: bytes,
    name: str,
    frame: int | None = None,
    kind: str = "an image",
    formats: tuple[str, ...] | None = None,
) -> Iterator[Any]:
    """An encoded image as a Pillow image, which is decoded in the block; errors are `DataError`s
    that call it ``name``, with `frame` set if it is given."""
    from PIL import Image, UnidentifiedImageError  # the layout of `encode` does not need it

    try:
        with (
            warnings.catch_warnings(action="ignore"),
            Image.open(io.BytesIO(blob), formats=formats) as image,
        ):
            yield image
    except UnidentifiedImageError as error:
        raise DataError.without_place(f"{name} is not {kind}", frame) from error
    except Exception as error:  # Pillow's parsers raise many types on damaged files
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DataError.without_place(
            f"{name} is not {kind} that can be read: {reason}", frame
        ) from error
