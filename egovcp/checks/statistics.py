"""Do the statistics of a dataset, which normalise every network's input, fit its frames?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from egovcp.data import DatasetReader, Episode, schema
from egovcp.data.columns import EPISODE_FEATURES
from egovcp.errors import DataError

_RELATIVE = 1e-4  # of the column's range: statistics may have been gathered in float32
_LEAST = 1e-6

type Moments = dict[str, NDArray[np.float64]]


class Totals:
    """Count, minimum, maximum, mean and standard deviation over episodes, one by one."""

    def __init__(self) -> None:
        self.frames = 0
        self._parts: dict[str, list[tuple[int, Moments]]] = {name: [] for name in EPISODE_FEATURES}

    def add(self, episode: Episode) -> None:
        """Take in an episode."""
        self.frames += len(episode)
        for name, parts in self._parts.items():
            parts.append((len(episode), _moments(getattr(episode, name), name)))

    def problems(self, reader: DatasetReader) -> Iterator[DataError]:
        """What differs from ``meta/stats.json``, if every frame of the dataset was added.

        Raises:
            DataError: the file is missing or damaged.
        """
        path, found = reader.root / schema.STATS_PATH, reader.stats
        for key in schema.FEATURES:
            if not isinstance(found.get(key), dict):
                yield DataError.at(path, f"has no statistics of {key}")
        if self.frames != reader.num_frames:
            return
        for name, key in EPISODE_FEATURES.items():
            if isinstance(found.get(key), dict):
                true = _joined(self._parts[name])
                for problem in _differences(found[key], true, self.frames):
                    yield DataError.at(path, f"{key}: {problem}")


def _moments(values: NDArray[np.generic], name: str) -> Moments:
    """Each (D,), or (1,) for depth, over all frames (and pixels) of an episode."""
    rows = values.reshape(-1, 1) if name == "depth" else values.reshape(len(values), -1)
    if rows.dtype == np.bool_:
        rows = rows.astype(np.uint8)
    mean = rows.mean(0, dtype=np.float64)
    return {
        "min": rows.min(0).astype(np.float64),
        "max": rows.max(0).astype(np.float64),
        "mean": mean,
        "square": rows.var(0, dtype=np.float64) + mean**2,
    }


def _joined(parts: list[tuple[int, Moments]]) -> Moments:
    weight = np.array([frames for frames, _ in parts], dtype=np.float64)
    stacked = {name: np.stack([moments[name] for _, moments in parts]) for name in parts[0][1]}
    mean, square = (np.average(stacked[n], axis=0, weights=weight) for n in ("mean", "square"))
    return {
        "min": stacked["min"].min(0),
        "max": stacked["max"].max(0),
        "mean": mean,
        "std": np.sqrt(np.maximum(square - mean**2, 0.0)),
    }


def _differences(found: dict[str, object], true: Moments, frames: int) -> Iterator[str]:
    slack = _RELATIVE * (true["max"] - true["min"] + np.abs(true["mean"])) + _LEAST
    for name, expected in true.items():
        try:
            values = np.asarray(found.get(name), dtype=np.float64).reshape(-1)
        except (TypeError, ValueError):
            values = np.empty(0)
        if values.shape != expected.shape:
            yield f"{name} is missing or has not {len(expected)} values"
        elif not (np.abs(values - expected) <= slack).all():
            at = int(np.argmax(~(np.abs(values - expected) <= slack)))
            yield f"{name} of value {at} is {values[at]:.6g}, its frames have {expected[at]:.6g}"
    if found.get("count") != [frames]:
        yield f"count is {found.get('count')}, expected [{frames}]"
