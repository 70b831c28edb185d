"""The experiments, one module each, with

SUMMARY                   the line in ``egovcp-experiment --help``
cells(config)             all cells, each after those it needs
report(config, records)   the `ExperimentReport` of the available results
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

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

EXPERIMENTS: Final[Mapping[str, Any]] = {
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
