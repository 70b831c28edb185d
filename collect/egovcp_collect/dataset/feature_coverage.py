"""Coverage of a LeRobot v3 dataset of any features: episode lengths and the range of each value."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Final

import numpy as np

from egovcp.checks.feature_statistics import Statistics, describe
from egovcp.data.features import values_of
from egovcp.data.lerobot import LeRobotReader
from egovcp.data.stats import aggregate_named
from egovcp.errors import DataError
from egovcp.terminal import echo, echo_lines
from egovcp_collect.dataset.statistics import Distribution

_CONSTANT: Final = 1e-8  # standard deviation relative to the magnitude
_SHORT_S: Final = 1.0


def report_features(reader: LeRobotReader) -> dict[str, Any]:
    """Print the coverage and its assessment; returns them, JSON-compatible.

    Raises:
        DataError: a file is damaged.
    """
    lengths = np.array([row.length for row in reader.rows]) / reader.fps
    features = {
        key: {
            reader.features[key].label(i): {name: float(value[i]) for name, value in found.items()}
            for i in range(reader.features[key].size)
        }
        for key, found in _statistics(reader).items()
    }
    echo(f"{reader.root}: {len(lengths)} episodes, {reader.num_frames} frames\n")
    spread = Distribution.of(lengths)
    if spread is not None:
        echo(
            f"length of an episode {spread.low:.2f} to {spread.high:.2f} s, mean {spread.mean:.2f}"
        )
    for key, values in features.items():
        echo_lines(["", f"{key:40}{'min':>11}{'mean':>11}{'max':>11}{'std':>11}"])
        for name, value in values.items():
            numbers = (value[part] for part in ("min", "mean", "max", "std"))
            echo(f"  {name:38}" + "".join(f"{number:11.4g}" for number in numbers))
    warnings = [
        f"{name} is always {value['mean']:g}: normalising divides by a standard deviation of 0"
        for values in features.values()
        for name, value in values.items()
        if value["std"] <= _CONSTANT * max(1.0, abs(value["mean"]))
    ]
    if short := int((lengths < _SHORT_S).sum()):
        warnings.append(f"{short} episodes are shorter than {_SHORT_S:g} s")
    missing = [key for key in ("action", "observation.state") if key not in reader.features]
    cameras = any(feature.is_camera for feature in reader.features.values())
    notes = ["cameras: their pixels are not read"] if cameras else []
    notes += [f"{key}: the dataset has none" for key in missing]
    if "next.reward" not in reader.features:
        notes.append("events, returns and success: there is no next.reward")
    echo("\nassessment")
    lines = [f"warning: {text}" for text in warnings]
    lines = lines or ["no value is constant, and no episode is short"]
    echo_lines(f"  {line}" for line in [*lines, *(f"not assessed: {note}" for note in notes)])
    length = asdict(spread) if spread is not None else None
    return {"length_s": length, "features": features, "warnings": warnings, "not_assessed": notes}


def _statistics(reader: LeRobotReader) -> dict[str, Statistics]:
    """Statistics of each numeric feature over all frames, (n,) each."""
    features = reader.numeric
    parts: dict[str, list[tuple[int, Statistics]]] = {f.key: [] for f in features}
    for path in reader.data_files:
        for found in reader.episodes(path, [*parts]):
            if isinstance(found, DataError):
                raise found
            number, table = found
            for feature in features:
                try:
                    values = values_of(table[feature.key], feature)
                except (DataError, KeyError) as error:
                    problem = getattr(error, "problem", "") or f"column {error} is missing"
                    raise DataError.at(path, problem, number) from error
                parts[feature.key].append((len(table), describe(values)))
    return {key: aggregate_named(found) for key, found in parts.items() if found}
