"""Depth images as TIFF: identical to Pillow's, and refused if damaged."""

import io

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from egovcp.data import tiff
from egovcp.errors import DataError


def _frames(count: int = 3) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 65536, (count, 48, 64)).astype(np.uint16)


def _pillow_blob(frame: np.ndarray, **options: str) -> bytes:
    out = io.BytesIO()
    Image.fromarray(frame).save(out, format="TIFF", **options)
    return out.getvalue()


def test_encoding_is_byte_for_byte_what_pillow_writes() -> None:
    frames = _frames()
    blobs = tiff.encode(frames).to_pylist()
    assert blobs == [_pillow_blob(frame, compression="raw") for frame in frames]


def test_decoding_inverts_encoding() -> None:
    frames = _frames()
    np.testing.assert_array_equal(tiff.decode(tiff.encode(frames), 48, 64), frames)
    np.testing.assert_array_equal(tiff.decode(tiff.encode(frames).slice(1, 2), 48, 64), frames[1:])


def test_a_foreign_tiff_layout_is_read_too() -> None:
    frames = _frames()
    blobs = tiff.encode(frames).to_pylist()
    blobs[1] = _pillow_blob(frames[1], compression="tiff_lzw")
    decoded = tiff.decode(pa.array(blobs, pa.binary()), 48, 64)
    np.testing.assert_array_equal(decoded, frames)


@pytest.mark.parametrize("cut", [0, 50, 3000])
def test_a_truncated_frame_is_refused(cut: int) -> None:
    blobs = tiff.encode(_frames()).to_pylist()
    blobs[2] = blobs[2][:cut]
    with pytest.raises(DataError, match="frame 2: its depth image"):
        tiff.decode(pa.array(blobs, pa.binary()), 48, 64)


def test_a_frame_of_another_size_is_refused() -> None:
    with pytest.raises(DataError, match="expected uint16 48x64"):
        tiff.decode(tiff.encode(np.zeros((1, 64, 48), np.uint16)), 48, 64)
