"""Decodes the images and videos of a LeRobot dataset."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egovcp.data import tiff
from egovcp.data.features import Feature
from egovcp.data.lerobot import EpisodeRow
from egovcp.errors import DataError

_LARGEST_CODE: Final = 4095  # of a depth video, 12 bits
#: Smaller codes are invalid: `quantize_depth` clips depth 0 to code 0, which a lossy codec changes
#: a little. Of LeRobot's default range these are depths below 28 mm, nearer than cameras measure.
_LEAST_CODE: Final = 16
#: LeRobot's defaults for depth videos, m.
_DEPTH_RANGE: Final[Mapping[str, float]] = {"depth_min": 0.01, "depth_max": 10.0}
_DEPTH_SHIFT: Final = 3.5


def camera_images(
    row: EpisodeRow, camera: Feature, table: pa.Table, times: NDArray[np.float64]
) -> Iterator[NDArray[Any]]:
    """The images of a camera in an episode: (H, W, 3) uint8; depth (H, W), uint16 in mm or float32
    in m.

    Args:
        table: the rows of the episode, which hold the images unless they are in a video.
        times: (T,) time of each row in the episode, s.

    Raises:
        DataError: with `frame` set, an image is damaged or missing.
    """
    if camera.dtype != "video":
        for frame, content in enumerate(table[camera.key]):
            yield np.asarray(decode_image(content.as_py(), frame, camera.key))
        return
    span, shown = row.videos[camera.key], 0
    for frame in decode_frames(span.path, span.start_s + times):
        shown += 1
        if camera.is_depth:
            yield _depth_of(frame.to_ndarray(format="gray16le") >> 4, camera.info)
        else:
            yield frame.to_ndarray(format="rgb24")
    if shown < len(times):
        problem = f"{camera.key} ends after {shown} of {len(times)} frames"
        raise DataError.at(span.path, problem, row.index, shown)


def _depth_of(codes: NDArray[np.uint16], info: Mapping[str, Any]) -> NDArray[np.float32]:
    """Depth, m, of the codes of a depth video, 0 where it is invalid; the inverse of LeRobot's
    `quantize_depth`."""
    low, high = (float(info.get(f"video.{name}", value)) for name, value in _DEPTH_RANGE.items())
    fraction = codes.astype(np.float64) / _LARGEST_CODE
    if info.get("video.use_log", True):
        shift = float(info.get("video.shift", _DEPTH_SHIFT))
        first, last = math.log(low + shift), math.log(high + shift)
        depth = np.exp(first + fraction * (last - first)) - shift
    else:
        depth = low + fraction * (high - low)
    return np.where(codes < _LEAST_CODE, 0, depth).astype(np.float32)


def decode_image(content: object, frame: int, key: str) -> Any:
    """The encoded image of a frame as a loaded Pillow image; raises `DataError` with `frame`."""
    if not isinstance(content, Mapping) or not content.get("bytes"):
        raise DataError.without_place(f"{key} has no image in the file", frame)
    with tiff.open_image(content["bytes"], key, frame) as image:
        image.load()
    return image


def frame_times(path: Path) -> NDArray[np.float64]:
    """(F,) presentation time of each frame of a video, s, ascending; nothing is decoded."""
    with _video(path) as (container, stream):
        pts = [p.pts for p in container.demux(stream) if p.pts is not None]
        return np.sort(np.array(pts, np.float64)) * float(stream.time_base)


def decode_frames(path: Path, times: Sequence[float] | NDArray[np.float64]) -> Iterator[Any]:
    """The frames (PyAV) of a video at some of its `frame_times`, ascending; the video may end
    before the last one."""
    with _video(path) as (container, stream):
        step = float(1 / (stream.average_rate or 30))
        container.seek(int(times[0] / float(stream.time_base)), stream=stream)
        wanted = iter(times)
        time = next(wanted)
        for frame in container.decode(stream):
            while frame.time is not None and frame.time > time - step / 2:
                yield frame
                try:
                    time = next(wanted)
                except StopIteration:
                    return


@contextmanager
def _video(path: Path) -> Iterator[tuple[Any, Any]]:
    """An open video file and its stream; errors of FFmpeg become `DataError`."""
    import av

    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise DataError.at(path, "holds no video")
            yield container, container.streams.video[0]
    except av.FFmpegError as error:
        problem = f"the video is damaged: {error.strerror or error}"
        raise DataError.at(path, problem) from error
