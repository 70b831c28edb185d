"""Compares the statistics of a dataset, which normalise network inputs, with its frames."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import DatasetReader, Episode, metadata, schema, stats
from egovcp.data.parquet import EPISODE_FEATURES, data_errors, open_parquet
from egovcp.errors import DataError

_RELATIVE = 1e-4  # of the column's range: statistics may be float32
_ABSOLUTE = 1e-6
#: LeRobot's editing tools copy these statistics unchanged from the source dataset.
_STALE = ("index", "episode_index", "task_index")
_CHECKED = tuple(key for key in schema.FEATURES if key not in _STALE)


class StatisticsCheck:
    """Compares ``meta/stats.json`` with the frames."""

    def __init__(self, reader: DatasetReader) -> None:
        self._reader = reader
        self._frames = 0
        self._total: stats.Matrix | None = None

    def add(self, episode: Episode) -> stats.Matrix:
        """Add a valid episode; returns the statistics (R, D) of its frames."""
        matrix = _statistics(self._reader, episode)
        parts = [matrix] if self._total is None else [self._total, matrix]
        counts = [len(episode)] if self._total is None else [self._frames, len(episode)]
        self._total = stats.aggregate(parts, counts)
        self._frames += len(episode)
        return matrix

    def problems(self) -> Iterator[DataError]:
        """Differences from ``meta/stats.json``, if all frames of the dataset were added.

        Raises:
            DataError: the file is missing or damaged.
        """
        path = self._reader.root / schema.STATS_PATH
        found = self._reader.stats
        for key in schema.FEATURES:
            if not isinstance(found.get(key), dict):
                yield DataError.at(path, f"has no statistics of {key}")
        if self._total is None or self._frames != self._reader.num_frames:
            return
        for key in _CHECKED:
            if isinstance(found.get(key), dict):
                for problem in _differences(found[key], self._total, key, self._frames):
                    yield DataError.at(path, f"{key}: {problem}")


class EpisodeStatistics:
    """Compares the statistics in ``meta/episodes`` with the frames, file by file."""

    def __init__(self, reader: DatasetReader) -> None:
        self._reader = reader
        self._rows = self._all_rows()

    def problems(self, index: int, matrix: stats.Matrix | None) -> Iterator[DataError]:
        """Differences from the table's row of an episode; call it for every episode in order.

        Args:
            index: the episode.
            matrix: statistics (R, D) of its frames; None: unknown.

        Raises:
            DataError: the table cannot be read.
        """
        found_row = next(self._rows, None)
        if found_row is None or matrix is None:
            return
        path, row = found_row
        for key in _CHECKED:
            prefix = f"stats/{key}/"
            found = {k.removeprefix(prefix): v for k, v in row.items() if k.startswith(prefix)}
            length = int(self._reader.lengths[index])
            for problem in _differences(found, matrix, key, length):
                yield DataError.at(path, f"statistics of {key}: {problem}", index)

    def _all_rows(self) -> Iterator[tuple[Any, Mapping[str, Any]]]:
        for path in metadata.episode_files(self._reader.root):
            with data_errors(path):
                file = open_parquet(path)
                names = [n for n in file.schema_arrow.names if n.startswith("stats/")]
                for group in range(file.num_row_groups):
                    for row in file.read_row_group(group, columns=names).to_pylist():
                        yield path, row


def _statistics(reader: DatasetReader, episode: Episode) -> stats.Matrix:
    """(R, D) of the frames of an episode."""
    columns = {key: getattr(episode, name) for name, key in EPISODE_FEATURES.items()}
    depth = columns.pop(spec.DEPTH_KEY)
    frames = np.arange(len(episode), dtype=np.int64)
    places: dict[str, NDArray[np.generic]] = {
        **dict.fromkeys(schema.INDEX_FEATURES, frames),  # those in _STALE are not compared
        "timestamp": (frames / reader.fps).astype(np.float32),
    }
    return np.concatenate([stats.data_stats(depth, columns), stats.index_stats(places)], axis=1)


def _differences(
    found: Mapping[str, object], matrix: stats.Matrix, key: str, frames: int
) -> Iterator[str]:
    part = matrix[:, stats.LAYOUT[key]]
    least, most, mean = part[0], part[1], part[2]
    slack = _RELATIVE * (most - least + np.abs(mean)) + _ABSOLUTE
    for name, expected in zip(stats.ROWS, part, strict=True):
        values = _numbers(found.get(name))
        if values is None or values.shape != expected.shape:
            yield f"{name} is missing or has not {len(expected)} numbers"
        elif not (np.abs(values - expected) <= slack).all():
            at = int(np.argmax(~(np.abs(values - expected) <= slack)))
            yield f"{name} of value {at} is {values[at]:.6g}, its frames have {expected[at]:.6g}"
    count = found.get("count")
    if count != [frames] or not isinstance(count, list) or isinstance(count[0], bool):
        yield f"count is {count!r:.80}, expected [{frames}]"


def _numbers(value: object) -> NDArray[np.float64] | None:
    """Nested lists of numbers as a flat array; None if they hold other values."""
    flat: list[float] = []
    waiting = [value]
    while waiting:
        item = waiting.pop()
        if isinstance(item, list):
            waiting += reversed(item)
        elif isinstance(item, int | float) and not isinstance(item, bool):
            flat.append(_as_float(item))
        else:
            return None
    return np.array(flat, dtype=np.float64)


def _as_float(number: float) -> float:
    try:
        return float(number)
    except OverflowError:  # an integer beyond 1.8e308
        return math.inf
