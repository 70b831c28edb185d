"""Decodes the images and videos of a LeRobot dataset."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovcp.data import tiff
from egovcp.errors import DataError


def decode_image(content: object, frame: int, key: str) -> Any:
    """The encoded image of a frame as a loaded Pillow image; raises `DataError` with `frame`."""
    from PIL import Image, UnidentifiedImageError

    if not isinstance(content, Mapping) or not content.get("bytes"):
        raise tiff.frame_error(frame, f"{key} has no image in the file")
    try:
        with warnings.catch_warnings(action="ignore"):
            image = Image.open(io.BytesIO(content["bytes"]))
            image.load()
    except UnidentifiedImageError as error:
        raise tiff.frame_error(frame, f"{key} is not an image") from error
    except Exception as error:  # Pillow's parsers raise many types on damaged files
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise tiff.frame_error(frame, f"{key} is not a readable image: {reason}") from error
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
