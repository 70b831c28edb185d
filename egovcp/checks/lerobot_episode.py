"""Checks of one episode of a LeRobot v3 dataset: values, timestamps, images, videos, statistics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egovcp.data import schema
from egovcp.data.camera_images import decode_image
from egovcp.data.features import Feature, nonfinite_problem
from egovcp.data.lerobot import LeRobotReader
from egovcp.errors import DataError, SchemaError

type Problem = tuple[int | None, str]
"""First frame at fault, or None; the problem."""

type Statistics = dict[str, NDArray[np.float64]]
"""Name of a statistic -> value for each value of a feature."""

#: LeRobot's default `tolerance_s`: a frame farther from its timestamp raises an error.
TOLERANCE_S: Final = 1e-4
_FLOAT32: Final = 2.0**-22  # relative error of a float32 timestamp


def value_problems(values: Mapping[str, NDArray[Any]], reader: LeRobotReader) -> Iterator[Problem]:
    for key, array in values.items():
        nonfinite = nonfinite_problem(array, reader.features[key])
        if nonfinite is not None:
            yield nonfinite
    if "frame_index" in values:
        found = values["frame_index"][:, 0]
        at_frame = first_difference(found, np.arange(len(found)))
        if at_frame is not None:
            problem = f"frame_index is {found[at_frame]}, expected {at_frame}"
            yield at_frame, f"{problem}: a frame is missing, repeated, or of another episode"
    if "timestamp" in values:
        times = values["timestamp"][:, 0].astype(np.float64)
        yield from _time_problems(times, reader.fps, bool(reader.keys("video")))
    if "task_index" in values and reader.tasks:
        known = np.isin(values["task_index"][:, 0], list(reader.tasks))
        if not known.all():
            at = int(np.argmin(known))
            index = values["task_index"][at, 0]
            yield at, f"task_index {index} is not in {schema.TASKS_PATH}, which has no text for it"


def _time_problems(times: NDArray[np.float64], fps: float, has_videos: bool) -> Iterator[Problem]:
    expected = np.arange(len(times)) / fps
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        at = int(back[0]) + 1
        yield at, f"timestamp {times[at]:g} s follows {times[at - 1]:g} s; timestamps must increase"
        return
    off = np.abs(times - expected)
    late = np.flatnonzero(off > TOLERANCE_S + _FLOAT32 * expected)
    if len(late) and has_videos:
        at = int(late[0])
        problem = f"timestamp {times[at]:g} s, expected {expected[at]:g} at {fps:g} fps"
        yield at, f"{problem}; LeRobot does not find its video frame"


def span_problem(shown: NDArray[np.float64], wanted: NDArray[np.float64]) -> tuple[int | None, str]:
    """The first of the times ``wanted`` (T,) that a video with frame times (F,) does not show."""
    if not len(shown):
        return None, "the video has no frame"
    right = np.clip(np.searchsorted(shown, wanted), 1, max(len(shown) - 1, 1))
    pair = np.stack([shown[right - 1], shown[np.minimum(right, len(shown) - 1)]])
    distance = np.abs(pair - wanted).min(0)
    far = np.flatnonzero(distance > TOLERANCE_S + _FLOAT32 * wanted)
    if not len(far):
        return None, ""
    at = int(far[0])
    if wanted[at] > shown[-1]:
        missing = int((wanted > shown[-1] + TOLERANCE_S).sum())
        end = f"the video ends at {shown[-1]:g} s after {len(shown)} frames"
        return at, f"{end}; {missing} of the episode's {len(wanted)} frames are missing"
    return at, (
        f"no video frame within {TOLERANCE_S * 1e3:g} ms of {wanted[at]:.5f} s, the nearest is "
        f"{distance[at] * 1e3:.3g} ms away; LeRobot raises FrameTimestampError"
    )


def check_images(column: pa.ChunkedArray, feature: Feature) -> None:
    for frame, content in enumerate(value.as_py() for value in column):
        image = decode_image(content, frame, feature.key)
        try:
            check_size(image.size, feature)
        except DataError as error:
            error.frame = frame
            raise


def check_size(size: tuple[int, int], feature: Feature) -> None:
    """Raise `DataError` if a picture (width, height) has not the shape of its feature, which may
    have the channels first or last."""
    width, height = size
    if (height, width) not in (feature.shape[:2], feature.shape[-2:]):
        shape = list(feature.shape)
        raise SchemaError.without_place(
            f"{feature.key} is {height}x{width}, but its shape is {shape}"
        )


def first_difference(found: NDArray[Any], expected: NDArray[Any]) -> int | None:
    wrong = np.flatnonzero(found != expected)
    return int(wrong[0]) if len(wrong) else None


def describe(values: NDArray[Any]) -> Statistics:
    """min, max, mean and std of values (T, n), (n,) each."""
    array = values.astype(np.float64)
    return {"min": array.min(0), "max": array.max(0), "mean": array.mean(0), "std": array.std(0)}


def statistics_problems(
    found: Mapping[str, object], expected: Statistics, feature: Feature
) -> Iterator[str]:
    """Recorded statistics that contradict those of the frames.

    LeRobot computes them in float32, and the variance as E[x^2] - E[x]^2, so that small deviations
    are no contradiction.
    """
    least = numbers_in(found.get("min"))
    if least is not None and len(feature.shape) > 1 and len(least) == feature.size:
        return  # of an episode with a single frame, for which LeRobot reduces no axis
    largest = np.maximum(np.abs(expected["min"]), np.abs(expected["max"]))
    slack = 1e-4 * largest + 1e-3 * (expected["max"] - expected["min"]) + 1e-6
    slacks = {**dict.fromkeys(expected, slack), "std": slack + 5e-3 * largest}
    yield from wrong_statistics(found, expected, slacks, feature)


def wrong_statistics(
    found: Mapping[str, object], expected: Statistics, slacks: Statistics, feature: Feature
) -> Iterator[str]:
    """Recorded statistics that are missing, or off by more than their slack."""
    for name, want in expected.items():
        values = numbers_in(found.get(name))
        if values is None or values.shape != want.shape:
            yield f"{name} is missing or does not have {len(want)} numbers"
            continue
        wrong = ~(np.abs(values - want) <= slacks[name])
        if wrong.any():
            at = int(np.argmax(wrong))
            yield (
                f"{name} of {feature.label(at)} is {values[at]:.6g}, its frames have "
                f"{want[at]:.6g}; training would normalise with it"
            )


def camera_statistics_problems(found: Mapping[str, object], feature: Feature) -> Iterator[str]:
    """Recorded statistics of images that cannot be right."""
    for name in ("min", "max", "mean", "std"):
        values = numbers_in(found.get(name))
        if values is None or not np.isfinite(values).all():
            yield f"{name} is missing or holds other things than finite numbers"
        elif not feature.is_depth and not ((values >= 0) & (values <= 1)).all():
            yield f"{name} is {values.max():g}, but that of colour images lies in [0, 1]"


def numbers_in(value: object) -> NDArray[np.float64] | None:
    """Nested lists of numbers or booleans as a flat array; None if they hold other values."""
    try:
        array = np.array(value)
    except ValueError:  # lists of different lengths
        return None
    return array.ravel().astype(np.float64) if array.dtype.kind in "biuf" else None
