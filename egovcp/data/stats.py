"""Per-episode statistics and their aggregate, in the shape LeRobot stores them.

All columns of an episode share one matrix ``(R, D)``: a row per statistic, a column per
scalar (depth counts as one, over all pixels). Aggregation, as in LeRobot, is exact for
min, max, mean and std, and the count-weighted mean of the episodes' quantiles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import schema
from egovcp.robot_spec import G1, RobotSpec

QUANTILES: Final = (0.01, 0.10, 0.50, 0.90, 0.99)
ROWS: Final = ("min", "max", "mean", "std", *(f"q{round(100 * q):02d}" for q in QUANTILES))

type Matrix = NDArray[np.float64]


@cache
def layout(robot: RobotSpec = G1) -> Mapping[str, slice]:
    """Feature -> its columns of a matrix, in the order of `schema.FEATURES`."""
    slices, start = {spec.DEPTH_KEY: slice(0, 1)}, 1
    for key in schema.NUMERIC_KEYS:
        slices[key] = slice(start, start + schema.width(key, robot))
        start = slices[key].stop
    return slices


def data_stats(depth: NDArray[np.uint16], columns: Mapping[str, NDArray[np.generic]]) -> Matrix:
    """Statistics ``(R, D1)`` of depth (T, H, W), mm, and of `schema.DATA_KEYS`, (T,) or (T, n)."""
    return np.concatenate([_depth_stats(depth), _numeric_stats(columns, schema.DATA_KEYS)], axis=1)


def index_stats(columns: Mapping[str, NDArray[np.generic]]) -> Matrix:
    """Statistics ``(R, D2)`` of `schema.INDEX_FEATURES`, (T,) each."""
    return _numeric_stats(columns, tuple(schema.INDEX_FEATURES))


def _numeric_stats(columns: Mapping[str, NDArray[np.generic]], keys: Sequence[str]) -> Matrix:
    blocks = [np.asarray(columns[key]).reshape(len(columns[key]), -1) for key in keys]
    values = np.concatenate(blocks, axis=1, dtype=np.float64, casting="unsafe")
    numeric = np.stack([values.min(0), values.max(0), values.mean(0), values.std(0)])
    return np.concatenate([numeric, np.quantile(values, QUANTILES, axis=0)])


def _depth_stats(depth: NDArray[np.uint16]) -> Matrix:
    """(R, 1) from the histogram of all pixels: exact, in one pass."""
    counts = np.bincount(depth.reshape(-1))
    present = np.flatnonzero(counts)
    weights = counts[present]
    total = int(weights.sum())
    mean = float(present @ weights) / total
    std = np.sqrt(float((present - mean) ** 2 @ weights) / total)
    ranks = np.searchsorted(weights.cumsum(), np.asarray(QUANTILES) * (total - 1), side="right")
    quantiles = present[ranks]
    return np.array([present[0], present[-1], mean, std, *quantiles], dtype=np.float64)[:, None]


def aggregate(matrices: Sequence[Matrix], counts: Sequence[int]) -> Matrix:
    """Statistics of the union of episodes, or groups of them, with these frame counts."""
    named = [dict(zip(ROWS, matrix, strict=True)) for matrix in matrices]
    union = aggregate_named(list(zip(counts, named, strict=True)))
    return np.stack([union[name] for name in ROWS])


def aggregate_named(parts: Sequence[tuple[int, Mapping[str, Matrix]]]) -> dict[str, Matrix]:
    """Statistic -> its value for the union of parts, which have these frame counts.

    Of the statistics, min, max, mean and std must be in all parts; one that a part lacks is left
    out.
    """
    counts = np.array([count for count, _ in parts], np.float64)
    names = [name for name in parts[0][1] if all(name in part for _, part in parts)]
    stacked = {name: np.stack([part[name] for _, part in parts]) for name in names}
    weight = counts.reshape(-1, *[1] * (stacked["mean"].ndim - 1))
    out = {name: (values * weight).sum(0) / counts.sum() for name, values in stacked.items()}
    spread = stacked["std"] ** 2 + (stacked["mean"] - out["mean"]) ** 2
    out["std"] = np.sqrt((spread * weight).sum(0) / counts.sum())
    return {**out, "min": stacked["min"].min(0), "max": stacked["max"].max(0)}


def to_json(matrix: Matrix, count: int, robot: RobotSpec = G1) -> dict[str, dict[str, object]]:
    return {
        key: {
            **{row: _nested(key, matrix[None, i, part])[0] for i, row in enumerate(ROWS)},
            "count": [count],
        }
        for key, part in layout(robot).items()
    }


def to_arrow(
    matrices: Sequence[Matrix], counts: Sequence[int], robot: RobotSpec = G1
) -> dict[str, pa.Array]:
    """``stats/<feature>/<statistic>`` columns of the episodes table, one row per episode."""
    stacked = np.stack(matrices)
    columns: dict[str, pa.Array] = {}
    for key, part in layout(robot).items():
        for i, row in enumerate(ROWS):
            columns[f"stats/{key}/{row}"] = pa.array(_nested(key, stacked[:, i, part]))
        columns[f"stats/{key}/count"] = pa.array([[count] for count in counts])
    return columns


def _nested(key: str, values: Matrix) -> list[Any]:
    """Values (E, n) of a feature as lists; of depth as (1, 1, 1) like an image."""
    nested: list[Any] = (values[..., None, None] if key == spec.DEPTH_KEY else values).tolist()
    return nested


def from_arrow(table: pa.Table, robot: RobotSpec = G1) -> list[Matrix]:
    """The matrices ``(R, D)`` of the episodes in a table of `to_arrow`."""
    places = layout(robot)
    out = np.empty((table.num_rows, len(ROWS), max(part.stop for part in places.values())))
    for key, part in places.items():
        for i, row in enumerate(ROWS):
            values = np.array(table[f"stats/{key}/{row}"].to_pylist())
            out[:, i, part] = values.reshape(table.num_rows, -1)
    return list(out)
