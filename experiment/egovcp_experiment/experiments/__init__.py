"""The experiments, one module each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

from egovcp.errors import UsageError
from egovcp_experiment.cell import Cell
from egovcp_experiment.config import SCALES, ExperimentConfig
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
from egovcp_experiment.grid import Grid
from egovcp_experiment.report import ExperimentReport
from egovcp_experiment.results import Records


@dataclass(frozen=True)
class Experiment:
    """One of the paper's experiments."""

    summary: str
    """The line in ``egovcp-experiment --help``."""
    make: Callable[[Grid, Records], ExperimentReport]
    """Requests all cells from the grid, and reports those that have results."""
    has_variants: bool = False
    """Whether ``--only`` and ``--most`` choose variants."""
    seeds: tuple[int, ...] = (0,)
    """Training seeds without ``--train.seeds``."""

    def cells(self, config: ExperimentConfig) -> list[Cell]:
        """All cells in dependency order: those that a report without results requests.

        Raises:
            UsageError: an option is invalid for this experiment.
        """
        most = config.most != SCALES[config.scale]().most
        if not self.has_variants and (config.only or most):
            option = "most" if most else "only"
            raise UsageError(f"--{option}: this experiment has no variants to choose; omit it")
        grid = self._grid(config)
        self.make(grid, {})
        return grid.cells

    def report(self, config: ExperimentConfig, records: Records) -> ExperimentReport:
        """The report of the available results."""
        return self.make(self._grid(config), records)

    def _grid(self, config: ExperimentConfig) -> Grid:
        seeds = config.train.seeds or self.seeds
        return Grid(replace(config, train=replace(config.train, seeds=seeds)))


EXPERIMENTS: Final[Mapping[str, Experiment]] = {
    "ablations": Experiment(
        "effect of each design choice on held-out metrics",
        ablations.report,
        has_variants=True,
    ),
    "generalise": Experiment(
        "unseen boxes, sizes, speeds, walls and arches; noise, delay and physics; several tasks in "
        "one episode (fig. 4a)",
        generalise.report,
        has_variants=True,
    ),
    "interpret": Experiment(
        "value maps of a hand, open-loop images, and behaviour with and without events (fig. 7)",
        interpret.report,
        has_variants=True,
    ),
    "multitask": Experiment(
        "one model on mixed data against one per task; t-SNE of h and z (fig. 6)", multitask.report
    ),
    "planners": Experiment(
        "CEM, iCEM, MPPI and random shooting in equal time; single options of the planner",
        planners.report,
        has_variants=True,
    ),
    "ppo": Experiment("learning curve of PPO, compared with the planner", ppo.report),
    "sample-efficiency": Experiment(
        "success against the transitions and gradient steps of a model (fig. 5)",
        sample_efficiency.report,
        seeds=(0, 1, 2),
    ),
    "table1": Experiment(
        "horizons, ARWM, Rew-MPC and TD-MPC next to ours; tests of the paper's ordering (table I)",
        table1.report,
        has_variants=True,
        seeds=(0, 1, 2),
    ),
    "variance": Experiment(
        "do errors of Q average out along a plan, and does that predict the best horizon "
        "(section III-D)?",
        variance.report,
    ),
}
