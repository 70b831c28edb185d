"""What an experiment is: the cells it rests on, and the report it makes of their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from egovcp_experiment.cell import Cell
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.report.document import Report
from egovcp_experiment.store import Record


@dataclass(frozen=True)
class Experiment:
    """One question."""

    summary: str
    """What `egovcp-experiment --help` says of it."""
    cells: Callable[[ExperimentConfig], list[Cell]]
    """Every cell after those it needs."""
    report: Callable[[ExperimentConfig, Mapping[str, Record]], Report]
    """From the results that are there; cells that have failed are not."""
