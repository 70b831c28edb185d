"""One model on the data of all tasks against one for each task (figure 6)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from egovcp.manifest import MANIFEST, read_manifest
from egovcp_experiment.cell import Cell
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.experiment import Experiment
from egovcp_experiment.grid import ALL, REFERENCES, Grid, Variant
from egovcp_experiment.outcomes import Outcome, outcome
from egovcp_experiment.report.comparison import comparison
from egovcp_experiment.report.document import Plot, Report, Table, number
from egovcp_experiment.report.svg import drawn
from egovcp_experiment.store import Record
from egovcp_experiment.tools import study

SINGLE: Final = "single"
MIXED: Final = "mixed"
_LATENTS: Final = "latents"
_LATENT_EPISODES: Final = 16  # of each task; states are thinned out anyway


def _plays(config: ExperimentConfig, grid: Grid) -> dict[str, dict[str, list[str]]]:
    """Task -> `SINGLE` or `MIXED` -> names of its cells, one for each seed."""
    return {
        task: {
            SINGLE: [grid.play(task, s, Variant(SINGLE)).name for s in config.train.seeds],
            MIXED: [grid.play(task, s, Variant(MIXED), ALL).name for s in config.train.seeds],
        }
        for task in config.tasks
    }


def _latents(config: ExperimentConfig, grid: Grid) -> str:
    flags = {
        **grid.planner(ALL),
        "policy.path": grid.model(ALL, config.train.seeds[0]),
        "tasks": list(config.tasks),
        "episodes": min(config.play.episodes, _LATENT_EPISODES),
        "seed": config.play.seed,
    }
    return grid.add(Cell(_LATENTS, study("latents"), flags, config.scenes)).name


def _cells(config: ExperimentConfig) -> list[Cell]:
    grid = Grid(config)
    _plays(config, grid)
    for task in config.tasks:
        grid.references(task)
    _latents(config, grid)
    return grid.cells


def _report(config: ExperimentConfig, records: Mapping[str, Record]) -> Report:
    shows: list[str] = []
    parts: list[str | Table | Plot] = [f"{_lengths(config)}{_planners(config)}"]
    figures: dict[str, Any] = {}
    levels: dict[str, dict[str, float]] = {}
    for task, cells in _plays(config, Grid(config)).items():
        found = {k: o for k, v in cells.items() if (o := outcome(records, v, task)) is not None}
        others = {
            r: o
            for r in REFERENCES
            if (o := outcome(records, [f"references-{task}"], task, r)) is not None
        }
        figures[task] = {name: o.figures() for name, o in {**found, **others}.items()}
        if found:
            parts.append(comparison(task, {**found, **others}, SINGLE))
        if len(found) == 2:
            shows.append(_line(task, found))
        if "oracle" in others and "random" in others:
            levels[task] = {name: _level(o, others) for name, o in found.items()}
            figures[task]["normalised"] = levels[task]
    if levels:
        parts.insert(1, _levels_plot(levels))
    if _LATENTS in records:
        latents = records[_LATENTS]["figures"]
        parts += [_maps(latents), _neighbours(latents)]
        shows.append(_separation(latents))
        figures[_LATENTS] = {
            k: {n: latents[k][n] for n in ("same_task", "chance", "tick_r2")} for k in ("h", "z")
        }
    title = "Multi-task: one model on mixed data against one for each task"
    return Report(title, tuple(shows), tuple(parts), figures)


def _lengths(config: ExperimentConfig) -> str:
    """For how long the models were trained, those that were given included."""
    given = {who: p for who, p in config.train.policies.items() if who in _models(config)}
    if not given:
        return (
            f"Every model was trained for {config.train.budget}: the one on mixed data learns "
            f"{len(config.tasks)} tasks in the time that a single-task model has for one, and is "
            "told nothing of which task it is."
        )
    named = "; ".join(f"{_models(config)[who]}, {_steps(path)}" for who, path in given.items())
    rest = len(given) < len(_models(config))
    others = f" Every other model was trained for {config.train.budget}." if rest else ""
    return (
        f"Models that were there before (`--train.policies`): {named}.{others} The one on mixed "
        "data is told nothing of which task it is."
    )


def _steps(policy: str) -> str:
    folder = Path(os.path.expanduser(policy))
    if not (folder / MANIFEST).is_file():
        return f"`{policy}`"  # on the Hub, or gone since
    return f"{read_manifest(folder).get('step', '?')} gradient steps"


def _models(config: ExperimentConfig) -> dict[str, str]:
    """Task, or `ALL` -> what its model is called."""
    return {**{task: f"of {task} alone" for task in config.tasks}, ALL: "on mixed data"}


def _planners(config: ExperimentConfig) -> str:
    """In what the models' planners differ; empty if they do not."""
    own = config.play.task_flags
    return "".join(
        f" The model {words} is played with `{' '.join(own[model])}`."
        for model, words in _models(config).items()
        if own.get(model)
    )


def _level(played: Outcome, others: Mapping[str, Outcome]) -> float:
    """Reward per step, 0 where the random walk is and 1 where the oracle is."""
    low, high = others["random"].reward_per_step, others["oracle"].reward_per_step
    return (played.reward_per_step - low) / (high - low) if high != low else float("nan")


def _line(task: str, found: Mapping[str, Outcome]) -> str:
    single, mixed = found[SINGLE], found[MIXED]
    gain, (low, high) = mixed.success_gain(single)
    verdict = "better" if low > 0 else "worse" if high < 0 else "no different beyond chance"
    return (
        f"{task}: mixed {mixed.success_rate:.1%}, single {single.success_rate:.1%} success; mixed "
        f"is {verdict} ({100 * gain:+.1f} points, 95 % {100 * low:+.1f} to {100 * high:+.1f})"
    )


def _levels_plot(levels: Mapping[str, Mapping[str, float]]) -> Plot:
    def paint(figure: Any) -> None:
        axes = figure.subplots()
        at = np.arange(len(levels))
        for k, name in enumerate((SINGLE, MIXED)):
            heights = [row.get(name, float("nan")) for row in levels.values()]
            axes.bar(at + 0.35 * (k - 0.5), heights, 0.33, label=name)
        axes.axhline(1, color="0.6", linewidth=0.8, linestyle=":")
        axes.axhline(0, color="0.3", linewidth=0.8)
        axes.set_xticks(at, list(levels))
        axes.set_ylabel("reward, 0 random, 1 oracle")
        axes.legend(fontsize=8)

    return drawn("normalised", "Reward per step: 0 a random walk, 1 the oracle", paint, (5.0, 3.0))


def _maps(latents: Mapping[str, Any]) -> Plot:
    task, tick = np.array(latents["task"]), np.array(latents["tick"])

    def paint(figure: Any) -> None:
        for k, name in enumerate(("h", "z")):
            points = np.array(latents[name]["map"])
            by_task, by_time = (
                figure.add_subplot(2, 2, 2 * k + 1),
                figure.add_subplot(2, 2, 2 * k + 2),
            )
            for i, words in enumerate(latents["tasks"]):
                own = task == i
                by_task.scatter(*points[own].T, s=4, label=words, linewidths=0)
            shades = by_time.scatter(*points.T, s=4, c=tick, cmap="viridis", linewidths=0)
            by_task.set_ylabel(name)
            by_task.set_title("by task", fontsize=8)
            by_time.set_title("by tick", fontsize=8)
            by_task.legend(fontsize=7, markerscale=3)
            figure.colorbar(shades, ax=by_time)
            for axes in (by_task, by_time):
                axes.set(xticks=[], yticks=[])

    caption = "t-SNE of h (above) and z (below) of the mixed model in closed loop"
    return drawn("latents", caption, paint, (8.0, 6.5))


def _neighbours(latents: Mapping[str, Any]) -> Table:
    rows = tuple(
        (
            name,
            f"{latents[name]['same_task']:.3f}",
            f"{latents[name]['chance']:.3f}",
            number(latents[name]["tick_r2"]),
        )
        for name in ("h", "z")
    )
    head = ("state", "neighbours of the same task", "by chance", "R2 of the tick from neighbours")
    return Table("Ten nearest states of other episodes, in the whole space", head, rows)


def _separation(latents: Mapping[str, Any]) -> str:
    h, z = latents["h"], latents["z"]
    return (
        f"the nearest states of other episodes are of the same task in {h['same_task']:.1%} (h) "
        f"and {z['same_task']:.1%} (z) of cases, by chance in {h['chance']:.1%}; they tell "
        f"{number(h['tick_r2'], '.2f')} (h) and {number(z['tick_r2'], '.2f')} (z) of the variance "
        "of time within a task"
    )


EXPERIMENT: Final = Experiment(
    "one model on mixed data against one for each task; t-SNE of h and z (fig. 6)", _cells, _report
)
