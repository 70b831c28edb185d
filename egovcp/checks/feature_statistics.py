"""Statistics of a feature over frames, and how recorded ones may differ from them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovcp.data.features import Feature

type Statistics = dict[str, NDArray[np.float64]]
"""Name of a statistic -> value for each value of a feature."""


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
    largest = np.maximum(np.abs(expected["min"]), np.abs(expected["max"]))
    spread = expected["max"] - expected["min"]
    slack = 1e-4 * largest + 1e-3 * spread + 1e-6
    for name, want in expected.items():
        values = numbers_in(found.get(name))
        if values is not None and len(feature.shape) > 1 and len(values) == feature.size:
            return  # of an episode with a single frame, for which LeRobot reduces no axis
        if values is None or values.shape != want.shape:
            yield f"{name} is missing or has not {len(want)} numbers"
            continue
        off = np.abs(values - want)
        wrong = ~(off <= (slack + 5e-3 * largest if name == "std" else slack))
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
    """Nested lists of numbers as a flat array; None if they hold other values."""
    try:
        array = np.array(value)
    except ValueError:  # lists of different lengths
        return None
    return array.ravel().astype(np.float64) if array.dtype.kind in "iuf" else None
