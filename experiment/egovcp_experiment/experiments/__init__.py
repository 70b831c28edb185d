"""The experiments, one module each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from egovcp_experiment.experiment import Experiment
from egovcp_experiment.experiments import (
    ablations,
    generalise,
    interpret,
    multitask,
    planners,
    sample_efficiency,
    variance,
)

EXPERIMENTS: Final[Mapping[str, Experiment]] = {
    "ablations": ablations.EXPERIMENT,
    "generalise": generalise.EXPERIMENT,
    "interpret": interpret.EXPERIMENT,
    "multitask": multitask.EXPERIMENT,
    "planners": planners.EXPERIMENT,
    "sample-efficiency": sample_efficiency.EXPERIMENT,
    "variance": variance.EXPERIMENT,
}
