"""Success and reward against the transitions that a model has seen (figure 5).

Models are trained equally long on growing first parts of one dataset; PPO's curve is one training.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from egovcp.eval_scores import EvalScores
from egovcp_experiment import results
from egovcp_experiment.cell import Cell
from egovcp_experiment.config import TASKS, EpisodesConfig, ExperimentConfig
from egovcp_experiment.experiments.ppo import (
    ppo_plays,
    ppo_scores,
    steps_per_episode,
    steps_text,
)
from egovcp_experiment.grid import BOUNDS, Grid, Model, Variant
from egovcp_experiment.report import ExperimentReport, Part

SUMMARY: Final = "success against the transitions that a model has seen (fig. 5)"


def _episodes(config: ExperimentConfig, task: str, part: float) -> int:
    """Number of first episodes in a part."""
    whole: int = getattr(config.data.episodes, task)
    return max(1, round(part * whole))


def _grid(config: ExperimentConfig) -> Grid:
    """A grid whose datasets are as large as the largest part."""
    largest = max(1.0, *config.data.parts)
    episodes = {task: _episodes(config, task, largest) for task in TASKS}
    data = replace(config.data, episodes=EpisodesConfig(**episodes))
    return Grid(replace(config, data=data))


def _model(config: ExperimentConfig, grid: Grid, task: str, part: float) -> Model:
    """A model of a part. That of all episodes is the default model of other experiments, unless the
    user gave a policy or a dataset of unknown size."""
    episodes = _episodes(config, task, part)
    shared = grid.config.data.episodes == config.data.episodes
    given = task in config.train.policies or task in config.data.roots
    if shared and not given and episodes == _episodes(config, task, 1.0):
        return Model()
    return Model(f"first_{episodes}", {"dataset.episodes": f"0:{episodes}"})


def _plays(config: ExperimentConfig, grid: Grid, task: str) -> dict[float, list[str]]:
    """Part of the data -> names of its cells, one per seed."""
    found = {}
    for part in config.data.parts:
        name = f"first_{_episodes(config, task, part)}"
        found[part] = grid.plays(task, Variant(name, _model(config, grid, task, part)))
    grid.bounds(task)
    ppo_plays(grid, task)
    return found


def cells(config: ExperimentConfig) -> list[Cell]:
    grid = _grid(config)
    for task in config.tasks:
        _plays(config, grid, task)
    return grid.cells


def report(config: ExperimentConfig, records: results.Records) -> ExperimentReport:
    grid = _grid(config)
    shows: list[str] = []
    tables: list[Part] = []
    figures: dict[str, Any] = {}
    curves: list[results.Curve] = []
    ppo_curves: list[results.Curve] = []
    for task in config.tasks:
        scores = results.all_scores(records, _plays(config, grid, task), task)
        if not scores:
            continue
        length = steps_per_episode(grid, task, records)
        sizes = {part: round(_episodes(config, task, part) * length) for part in scores}
        ppo = ppo_scores(grid, task, records)
        colour = f"C{len(curves)}"
        curves.append(results.Curve(task, {sizes[p]: each for p, each in scores.items()}, colour))
        if ppo:
            ppo_curves.append(results.Curve(f"{task}, PPO", ppo, colour, "x--"))
        named = {steps_text(sizes[p]): each for p, each in scores.items()}
        shown = {
            **named,
            **{f"PPO, {steps_text(n)}": each for n, each in ppo.items()},
            **results.controller_scores(records, f"bounds-{task}", task, BOUNDS),
        }
        tables.append(results.comparison(task, shown, list(named)[-1]))
        shows.append(_conclusion(task, named))
        figures[task] = results.figures_of(shown)
    parts: list[Part] = [
        f"Every model was trained for {config.train.budget} on the first episodes of one random "
        "dataset, whatever their number; a twentieth of them is held out. The model-free baseline "
        "(PPO, dashed) collects its transitions while it learns: its curve is one training."
    ]
    if curves:
        caption = "Success and reward against transitions"
        parts.append(results.learning_curves("transitions", caption, curves + ppo_curves))
    title = "Sample efficiency: success against the transitions that a model has seen"
    return ExperimentReport(title, tuple(shows), (*parts, *tables), figures)


def _conclusion(task: str, named: Mapping[str, EvalScores]) -> str:
    names = list(named)
    first, last = named[names[0]], named[names[-1]]
    if len(names) < 2:
        return f"{task}: {last.success_rate:.1%} success from {names[-1]}"
    gain = last.gain(first)
    word = gain.word("more data helps", "more data hurts", "no clear difference")
    return (
        f"{task}: {first.success_rate:.1%} success from {names[0]}, {last.success_rate:.1%} from "
        f"{names[-1]}: {word} ({gain})"
    )
