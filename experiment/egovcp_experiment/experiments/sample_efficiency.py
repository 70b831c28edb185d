"""Success and reward against the transitions that a model has seen (figure 5).

Models learn from growing first parts of one dataset, each for as long as any other; PPO's curve is
one training, played along its way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from egovcp.spec import TASKS
from egovcp_experiment import model_free
from egovcp_experiment.cell import Cell
from egovcp_experiment.config import EpisodesConfig, ExperimentConfig
from egovcp_experiment.experiment import Experiment
from egovcp_experiment.grid import BOUNDS, Grid, Model, Variant
from egovcp_experiment.outcomes import Outcome, outcome, side_by_side
from egovcp_experiment.report.comparison import comparison
from egovcp_experiment.report.curves import Curve, transitions_plot
from egovcp_experiment.report.document import Plot, Report, Table, points_range
from egovcp_experiment.report.heldout import Models, add, models_table
from egovcp_experiment.store import Record
from egovcp_experiment.transitions import per_episode, steps


def _episodes(config: ExperimentConfig, task: str, part: float) -> int:
    """How many of the first episodes make that part."""
    whole: int = getattr(config.data.episodes, task)
    return max(1, round(part * whole))


def _name(config: ExperimentConfig, task: str, part: float) -> str:
    return f"first_{_episodes(config, task, part)}"


def _grid(config: ExperimentConfig) -> Grid:
    """Its datasets are as large as the largest part."""
    largest = max(1.0, *config.data.parts)
    episodes = {task: _episodes(config, task, largest) for task in TASKS}
    data = replace(config.data, episodes=EpisodesConfig(**episodes))
    return Grid(replace(config, data=data))


def _model(config: ExperimentConfig, grid: Grid, task: str, part: float) -> Model:
    """One that learns from a part. From all episodes it is the model that other experiments train,
    unless they are given a model, or a dataset of whatever size."""
    episodes = _episodes(config, task, part)
    of_others = grid.config.data.episodes == config.data.episodes
    given = task in config.train.policies or task in config.data.roots
    if of_others and not given and episodes == _episodes(config, task, 1.0):
        return Model()
    return Model(_name(config, task, part), {"dataset.episodes": f"0:{episodes}"})


def _plays(config: ExperimentConfig, grid: Grid) -> dict[str, dict[float, list[str]]]:
    """Task -> part of the data -> names of its cells, one for each seed."""
    found: dict[str, dict[float, list[str]]] = {}
    for task in config.tasks:
        for part in config.data.parts:
            variant = Variant(_name(config, task, part), _model(config, grid, task, part))
            cells = [grid.play(task, seed, variant).name for seed in config.train.seeds]
            found.setdefault(task, {})[part] = cells
        grid.bounds(task)
        model_free.plays(grid, task)
    return found


def _cells(config: ExperimentConfig) -> list[Cell]:
    grid = _grid(config)
    _plays(config, grid)
    return grid.cells


def _report(config: ExperimentConfig, records: Mapping[str, Record]) -> Report:
    grid = _grid(config)
    shows: list[str] = []
    parts: list[str | Table | Plot] = [_training(config)]
    figures: dict[str, Any] = {}
    curves: dict[str, dict[int, Outcome]] = {}
    ppo: dict[str, dict[int, Outcome]] = {}
    models: Models = {}
    for task, cells in _plays(config, grid).items():
        found = {p: o for p, c in cells.items() if (o := outcome(records, c, task)) is not None}
        if not found:
            continue
        of_each = per_episode(grid, task, records)
        sizes = {p: round(_episodes(config, task, p) * of_each) for p in found}
        curves[task] = {sizes[p]: played for p, played in found.items()}
        for p in found:
            model = _model(config, grid, task, p)
            trained = [grid.train(task, seed, model).name for seed in config.train.seeds]
            add(models, task, steps(sizes[p]), trained, records)
        free = model_free.curve(grid, task, records)
        ppo[task] = free
        named = {steps(sizes[p]): played for p, played in found.items()}
        largest = list(named)[-1]
        shown = {
            **named,
            **{f"PPO, {steps(seen)}": played for seen, played in free.items()},
            **side_by_side(records, f"bounds-{task}", task, BOUNDS),
        }
        parts.append(comparison(task, shown, largest))
        shows += _shows(task, named)
        figures[task] = {name: o.figures() for name, o in shown.items()}
    if curves:
        parts.insert(1, _plot(curves, ppo))
    if models:
        parts.insert(2, models_table(models, "held-out episodes of their own part"))
        figures["models"] = models
    title = "Sample efficiency: success against the transitions that a model has seen"
    return Report(title, tuple(shows), tuple(parts), figures)


def _training(config: ExperimentConfig) -> str:
    return (
        f"Every model was trained for {config.train.budget} on the first episodes of one random "
        "dataset, whatever their number; a twentieth of them is held out. The model-free baseline "
        "(PPO, dashed) makes its transitions itself: its curve is one training, which updates "
        "as it goes."
    )


def _shows(task: str, named: Mapping[str, Outcome]) -> list[str]:
    names = list(named)
    first, last = named[names[0]], named[names[-1]]
    if len(names) < 2:
        return [f"{task}: {last.success_rate:.1%} success from {names[-1]}"]
    gain, (low, high) = last.reward_gain(first)
    more = (
        "more data helps" if low > 0 else "more data hurts" if high < 0 else "no clear difference"
    )
    won, interval = last.success_gain(first)
    return [
        f"{task}: {first.success_rate:.1%} success from {names[0]}, {last.success_rate:.1%} from "
        f"{names[-1]}: {more} (reward per step {gain:+.5f}, 95 % {low:+.5f} to {high:+.5f}; "
        f"success {100 * won:+.1f} points, {points_range(interval)})"
    ]


def _plot(
    curves: Mapping[str, Mapping[int, Outcome]], ppo: Mapping[str, Mapping[int, Outcome]]
) -> Plot:
    colours = {task: f"C{k}" for k, task in enumerate(curves)}
    ours = [Curve(task, row, colours[task]) for task, row in curves.items()]
    free = [Curve(f"{task}, PPO", r, colours[task], "x--") for task, r in ppo.items() if r]
    return transitions_plot("transitions", "Success and reward against transitions", ours + free)


EXPERIMENT: Final = Experiment(
    "success against the transitions that a model has seen (fig. 5)", _cells, _report
)
