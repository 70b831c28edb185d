"""Held-out metrics of world models with single choices changed.

One model per choice, with equal steps and seeds, on the data of all tasks together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from egovcp.errors import UsageError
from egovcp_experiment import results
from egovcp_experiment.cell import Flags
from egovcp_experiment.grid import Grid, Model
from egovcp_experiment.report import ExperimentReport, Table

#: Ablations that are presets of egovcp-train.
_PRESETS: Final = (
    "paper", "kl_equal", "kl_tenfold", "no_free_nats", "free_nats_per_dimension", "pixels_summed",
    "state_summed", "state_1", "no_motion_weight", "no_multistep", "no_proximity_weight",
    "value_weight_1", "no_imagined_value", "no_object", "monte_carlo", "no_sampled_actions",
)  # fmt: skip
#: Choice -> changed flags of egovcp-train.
CHOICES: Final[dict[str, Flags]] = {
    "default": {},
    **{name: {"preset": name} for name in _PRESETS},
    "raw_returns": {"returns.scale": "none"},
    "value_two_hot": {"policy.value_loss": "two_hot"},
    "reward_head": {"policy.loss.reward": 1},
    "arwm": {"policy.dynamics": "autoregressive"},
    "td": {"policy.loss.q_target": "td"},
    "short_windows": {"sampling.length": 16, "batch_size": 80},  # as many rows per step
}


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    """Request the cells of all choices; report those in ``records``.

    Raises:
        UsageError: a preset is given, which those of the choices would replace.
    """
    config = grid.config
    if config.train.preset != "default" and config.scale != "smoke":
        raise UsageError(
            f"--train.preset={config.train.preset}: ablations choose presets themselves; drop it"
        )
    trained_on = grid.trained_on
    trainings = {
        name: [
            grid.train(
                trained_on, seed, Model(name, flags), f"ablate-{trained_on}-{name}-s{seed}"
            ).name
            for seed in config.train.seeds
        ]
        for name, flags in config.chosen(CHOICES).items()
    }
    page = ExperimentReport(
        "Ablations: effect of each design choice on held-out metrics",
        sections=[
            f"Every model was trained for {config.train.steps} gradient steps on the "
            "data of all tasks named here together, and differs from `default` in the flags named. "
            "(x): times below the error of repeating the last image, at that many ticks "
            "open-loop. `paper` is judged against its own returns, which differ from those of the "
            "others."
        ],
    )
    for task in config.tasks:
        rows = {
            name: row
            for name, cells in trainings.items()
            if (row := results.heldout(records, cells, task))
        }
        page.findings += _conclusions(task, rows)
        page.sections.append(_table(task, rows))
        page.figures[task] = rows
    return page


def _conclusions(task: str, rows: Mapping[str, Mapping[str, Sequence[float]]]) -> list[str]:
    """The best choice by the main columns, and the rank of the default."""
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
    def changed(name: str) -> str:
        text = " ".join(f"{flag}={value}" for flag, value in CHOICES[name].items())
        return f"`{text}`" if text else ""

    return Table(
        f"{task} ({results.OVER_SEEDS})",
        ("choice", "changed", *results.HELDOUT),
        [
            (name, changed(name), *map(results.over_seeds, row.values()))
            for name, row in rows.items()
        ],
    )
