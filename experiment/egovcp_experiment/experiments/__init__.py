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
    ppo,
    sample_efficiency,
    table1,
    variance,
)

EXPERIMENTS: Final[Mapping[str, Experiment]] = {
    "ablations": ablations.EXPERIMENT,
    "generalise": generalise.EXPERIMENT,
    "interpret": interpret.EXPERIMENT,
    "multitask": multitask.EXPERIMENT,
    "planners": planners.EXPERIMENT,
    "ppo": ppo.EXPERIMENT,
    "sample-efficiency": sample_efficiency.EXPERIMENT,
    "table1": table1.EXPERIMENT,
    "variance": variance.EXPERIMENT,
}
