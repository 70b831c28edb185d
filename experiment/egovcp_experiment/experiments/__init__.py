"""The experiments, one module each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Protocol

from egovcp_experiment.cell import Cell, Record
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.experiments import (
    ablations,
    generalise,
    interpret,
    multitask,
    planners,
    ppo,
    sample_efficiency,
    table1,
    variance,
)
from egovcp_experiment.report import ExperimentReport


class Experiment(Protocol):
    """What a module of this package provides."""

    @property
    def SUMMARY(self) -> str:  # noqa: N802 - a constant of the module
        """Its line in `egovcp-experiment --help`."""
        ...

    def cells(self, config: ExperimentConfig) -> list[Cell]:
        """All cells, each after those it needs."""
        ...

    def report(self, config: ExperimentConfig, records: Mapping[str, Record]) -> ExperimentReport:
        """The report of the available results; those of failed cells are missing."""
        ...


EXPERIMENTS: Final[Mapping[str, Experiment]] = {
    "ablations": ablations,
    "generalise": generalise,
    "interpret": interpret,
    "multitask": multitask,
    "planners": planners,
    "ppo": ppo,
    "sample-efficiency": sample_efficiency,
    "table1": table1,
    "variance": variance,
}
