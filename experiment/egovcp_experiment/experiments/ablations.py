"""What each choice of the world model is worth, on held-out episodes.

One model for each choice, with equal steps and seeds, on the data of all tasks together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from egovcp_experiment.cell import Cell, Flags
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.experiment import Experiment
from egovcp_experiment.grid import ALL, Grid, Model
from egovcp_experiment.report.document import Report, Table
from egovcp_experiment.report.heldout import COLUMNS, OVER_SEEDS, measured, over_seeds
from egovcp_experiment.store import Record

#: Ablations that are presets of egovcp-train.
_PRESETS: Final = (
    *("paper", "kl_equal", "kl_tenfold", "no_free_nats", "free_nats_per_dimension"),
    *("pixels_summed", "state_summed", "state_1", "no_moving", "no_multistep", "no_near"),
    *("value_weight_1", "q_of_posterior_only"),
)
#: Choice -> flags of egovcp-train in which it differs from the default.
CHOICES: Final[dict[str, Flags]] = {
    "default": {},
    **{name: {"preset": name} for name in _PRESETS},
    "raw_returns": {"returns.scale": "none"},
    "value_mse": {"policy.value_loss": "mse"},
    "reward_head": {"policy.loss.reward": 1},
    "arwm": {"policy.dynamics": "autoregressive"},
    "td": {"policy.loss.q_target": "td"},
    "long_windows": {"sampling.length": 40, "batch_size": 8},  # as many rows per step
    "per_task_returns": {"returns.scale": "per_task"},
}


def _trainings(config: ExperimentConfig, grid: Grid) -> dict[str, list[Cell]]:
    """Choice -> its cells, one for each seed."""
    task = ALL if len(config.tasks) > 1 else config.tasks[0]
    equal = {"steps": config.train.compared_steps, "max_minutes": 0}
    return {
        name: [
            grid.train(task, seed, Model(name, {**equal, **flags}), f"ablate-{task}-{name}-s{seed}")
            for seed in config.train.seeds
        ]
        for name, flags in config.chosen(CHOICES).items()
    }


def _cells(config: ExperimentConfig) -> list[Cell]:
    grid = Grid(config)
    _trainings(config, grid)
    return grid.cells


def _report(config: ExperimentConfig, records: Mapping[str, Record]) -> Report:
    found = {
        name: [records[cell.name]["figures"]["tasks"] for cell in cells if cell.name in records]
        for name, cells in _trainings(config, Grid(config)).items()
    }
    found_by_task = {
        task: {name: measured([run[task] for run in runs]) for name, runs in found.items() if runs}
        for task in config.tasks
    }
    tables = tuple(_table(task, rows) for task, rows in found_by_task.items())
    return Report(
        title="Ablations: what each choice of the world model is worth on held-out episodes",
        shows=tuple(line for task, rows in found_by_task.items() for line in _shows(task, rows)),
        parts=(
            f"Every model was trained for {config.train.compared_steps} gradient steps on the "
            "data of all tasks named here together, and differs from `default` in the flags named. "
            "(x): times below the error of repeating the last image, at that many ticks "
            "open-loop. `paper` and `per_task_returns` are judged against their own returns, "
            "which differ from those of the others.",
            *tables,
        ),
        figures=found_by_task,
    )


def _shows(task: str, rows: Mapping[str, Mapping[str, Sequence[float]]]) -> list[str]:
    """The best choice of the columns that matter most, and where the default stands."""
    lines = []
    for column in ("moving, 8 (x)", "all pixels, 8 (x)", "Q R2"):
        means = {n: sum(row[column]) / len(row[column]) for n, row in rows.items() if row[column]}
        if len(means) > 1 and "default" in means:
            best = max(means, key=means.__getitem__)
            rank = 1 + sum(value > means["default"] for value in means.values())
            lines.append(
                f"{task}, {column}: `{best}` is best with {means[best]:.3g}; `default` has "
                f"{means['default']:.3g}, place {rank} of {len(means)}"
            )
    return lines


def _table(task: str, rows: Mapping[str, Mapping[str, Sequence[float]]]) -> Table:
    return Table(
        title=f"{task} ({OVER_SEEDS})",
        head=("choice", "changed", *COLUMNS),
        rows=tuple(
            (name, _changed(CHOICES[name]), *(over_seeds(values) for values in row.values()))
            for name, row in rows.items()
        ),
    )


def _changed(flags: Flags) -> str:
    text = " ".join(f"{name}={value}" for name, value in flags.items())
    return f"`{text}`" if text else ""


EXPERIMENT: Final = Experiment(
    "what each choice of the world model is worth on held-out episodes", _cells, _report
)
