"""An episode of a LeRobot v3 dataset of any features as a Rerun recording."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from egovcp.data import schema
from egovcp.data.camera_images import camera_images
from egovcp.data.features import Feature, values_of
from egovcp.data.lerobot import EpisodeRow, LeRobotReader
from egovcp.errors import DataError, EnvironmentFailure
from egovcp.files import removed_on_error
from egovcp.packages import require_packages


def record_features(reader: LeRobotReader, row: EpisodeRow, output: Path) -> list[str]:
    """Write an episode as the new recording ``output``; returns the features that it shows.

    Raises:
        DataError: the episode is damaged.
        EnvironmentFailure: ``output`` exists.
    """
    if output.exists():
        raise EnvironmentFailure(f"{output} exists already; choose another --output, or remove it")
    if "timestamp" not in reader.features:
        raise DataError.at(reader.root / schema.INFO_PATH, "feature timestamp is missing")
    features = {k: f for k, f in reader.features.items() if f.is_camera or f in reader.numeric}
    if reader.keys("video"):
        require_packages("egovcp", "a dataset with videos", "av")
    table = reader.read(row, [*(k for k, f in features.items() if f.dtype != "video"), "timestamp"])
    times = values_of(table["timestamp"], reader.features["timestamp"])[:, 0].astype(np.float64)
    stream = rr.RecordingStream("egovcp")
    output.parent.mkdir(parents=True, exist_ok=True)
    with removed_on_error(output):
        stream.save(output)
        stream.send_recording_name(f"{reader.root.name} episode {row.index}")
        for key, feature in features.items():
            if feature.is_camera:
                _log_camera(stream, feature, camera_images(row, feature, table, times), times)
            else:
                _log_values(stream, feature, values_of(table[key], feature), times)
        stream.flush(timeout_sec=60.0)
        stream.disconnect()
    return [*features]


def _log_values(
    stream: rr.RecordingStream, feature: Feature, values: NDArray[Any], times: NDArray[np.float64]
) -> None:
    path = feature.key.replace(".", "/")
    names = [feature.label(i).removeprefix(feature.key) for i in range(feature.size)]
    stream.log(path, rr.SeriesLines(names=[name.strip() or path for name in names]), static=True)
    index = [
        rr.TimeColumn("frame", sequence=np.arange(len(times))),
        rr.TimeColumn("time", duration=times),
    ]
    stream.send_columns(path, index, rr.Scalars.columns(scalars=values.astype(np.float64)))


def _log_camera(
    stream: rr.RecordingStream,
    feature: Feature,
    images: Iterator[NDArray[Any]],
    times: NDArray[np.float64],
) -> None:
    for number, image in enumerate(images):
        stream.set_time("frame", sequence=number)
        stream.set_time("time", duration=float(times[number]))
        per_metre = 1.0 if image.dtype == np.float32 else 1000.0
        shown = (
            rr.DepthImage(image, meter=per_metre)
            if feature.is_depth
            else rr.Image(image).compress(90)
        )
        stream.log(feature.key.replace(".", "/"), shown)
