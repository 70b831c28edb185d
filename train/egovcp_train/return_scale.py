"""The ablation `returns.scale=per_task`: each task's returns in deviations of that task.

Neither network nor planner sees the task, so Q then answers in deviations of a task it has to
guess; all that the task string decides is the unit of the targets.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from egovcp.data import EpisodeStore
from egovcp.errors import DataError

_FLOOR = 1e-6  # as of the deviation of all returns


class ReturnScale(NamedTuple):
    """Of the complete returns of a task."""

    mean: float
    std: float


def task_scales(store: EpisodeStore) -> dict[str, ReturnScale]:
    """Task -> the scale of its returns; tasks without a complete one are left out."""
    tasks = np.repeat(np.array(store.tasks), store.length)
    found: dict[str, ReturnScale] = {}
    for task in sorted(set(store.tasks)):
        returns = store.mc_return[store.mc_valid & (tasks == task)].astype(np.float64)
        if len(returns):
            found[task] = ReturnScale(float(returns.mean()), max(float(returns.std()), _FLOOR))
    return found


def on_task_scales(store: EpisodeStore, scales: Mapping[str, ReturnScale]) -> EpisodeStore:
    """The store with its returns in deviations from their task's mean.

    Raises:
        DataError: the scale of a task is not known.
    """
    unknown = sorted(set(store.tasks) - scales.keys())
    if unknown:
        raise DataError(
            f"no scale of returns is known for task {unknown[0]!r}, only for "
            f"{', '.join(sorted(scales)) or 'none'}; use --returns.scale=dataset, or other data"
        )
    mean, std = (
        np.repeat([getattr(scales[task], name) for task in store.tasks], store.length)
        for name in ReturnScale._fields
    )
    return dataclasses.replace(store, mc_return=((store.mc_return - mean) / std).astype(np.float32))
