"""How many transitions, planner ticks of 40 ms, a learner has seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from egovcp_experiment.cell import Given
from egovcp_experiment.grid import Grid
from egovcp_experiment.store import Record

_TICKS: Final[Mapping[str, float]] = {"ball": 150.0, "wall": 150.0, "arch": 230.0}


def per_episode(grid: Grid, task: str, records: Mapping[str, Record]) -> float:
    """Of the collected data; of a given dataset the scale's, which it is taken to have."""
    data = grid.data(task)
    if isinstance(data, Given) or data.cell not in records:
        return _TICKS[task]
    figures = records[data.cell]["figures"]
    return float(figures["steps"] / figures["episodes"])


def steps(count: int) -> str:
    """A number of transitions in words."""
    return f"{count / 1000:.0f}k steps" if count >= 10_000 else f"{count} steps"
