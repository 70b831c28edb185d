"""Success and reward against the transitions that a model has seen (figure 5).

Models of all tasks are trained equally long on growing first parts of the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from egovcp.errors import UsageError
from egovcp.eval_scores import EvalScores
from egovcp_experiment import results
from egovcp_experiment.cell import Flags
from egovcp_experiment.experiments.ppo import (
    LIMITS,
    ppo_scores,
    steps_per_episode,
    steps_text,
)
from egovcp_experiment.grid import REFERENCES, Grid, Model
from egovcp_experiment.report import ExperimentReport, listed, on_tasks, percent

_PPO: Final = ", PPO"


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    grid.collected = max(1.0, *config.data.parts)
    given = sorted(set(config.data.roots) & set(config.tasks))
    if grid.collected > 1 and given:
        parts = [part for part in config.data.parts if part <= 1]
        raise UsageError(
            f"--data.parts={list(config.data.parts)}: parts of the dataset given for {given[0]} "
            f"(--data.roots) are at most 1; give --data.parts={parts}"
        )
    introduction = (
        f"Every model was trained for the same number of gradient steps ({config.train.steps}) on "
        "growing first parts of the data; a twentieth of each part is held out. Transitions are "
        "those of one task."
    )
    if config.ppo.transitions:
        count = len(config.train.seeds)
        introduction += (
            " The model-free baseline (PPO, dashed) learns one task and collects its transitions "
            f"while it learns; its curve is that of {count} training{'s' * (count > 1)}. {LIMITS}"
        )
    page = ExperimentReport(
        "Sample efficiency: success against the transitions that a model has seen",
        sections=[introduction],
    )
    curves: list[results.Curve] = []
    ppo_curves: list[results.Curve] = []
    models = {part: _model(grid, part) for part in sorted(config.data.parts)}
    for task in config.tasks:
        plays = {part: grid.plays(task, m.name, model=m) for part, m in models.items()}
        references = grid.references(task)
        ppo = ppo_scores(grid, task, records)
        scores = results.all_scores(records, plays, task)
        if not scores:
            continue
        length = steps_per_episode(grid, task, records)
        sizes = {round(grid.episodes(task, part) * length): s for part, s in scores.items()}
        colour = f"C{len(curves)}"
        curves.append(results.Curve(task, sizes, colour))
        if ppo:
            ppo_curves.append(results.Curve(task + _PPO, ppo, colour, "x--"))
        named = {steps_text(size): each for size, each in sizes.items()}
        shown = {
            **named,
            **{f"PPO, {steps_text(n)}": each for n, each in ppo.items()},
            **results.controller_scores(records, references, task, REFERENCES),
        }
        page.sections.append(results.comparison(task, shown, list(named)[-1]))
        page.figures[task] = results.figures_of(shown)
    if curves:
        caption = "Success and reward against transitions"
        page.figure = results.learning_curves("transitions", caption, curves + ppo_curves)
    page.lead = _lead(curves, ppo_curves)
    return page


def _model(grid: Grid, part: float) -> Model:
    """A model of the first episodes of each task. That of all episodes is the default model of
    other experiments, unless the user gave a policy or a dataset."""
    config, tasks = grid.config, grid.config.tasks
    numbers = {task: grid.episodes(task, part) for task in tasks}
    given = grid.given_policy(grid.trained_on) or set(tasks) & set(config.data.roots)
    whole = all(
        n == grid.episodes(t) == grid.episodes(t, grid.collected) for t, n in numbers.items()
    )
    if whole and not given:
        return Model()
    flags: Flags = {"dataset.episodes": f"0:{numbers[tasks[0]]}"}
    if len(tasks) > 1:
        parts = [{"root": grid.data(task), "episodes": f"0:{n}"} for task, n in numbers.items()]
        flags = {"datasets": parts}
    return Model(f"part_{part:g}", flags)


def _lead(curves: Sequence[results.Curve], ppo: Sequence[results.Curve]) -> list[str]:
    ends = {curve.label: list(curve.points.items()) for curve in curves}
    rates = [
        f"{' to '.join(map(_rate, dict([points[0], points[-1]]).items()))} on {task}"
        for task, points in ends.items()
    ]
    lines = [f"Success with more data: {listed(rates)}."] if rates else []
    words = {
        task: points[-1][1].gain(points[0][1]).word("helps", "hurts", "makes no clear difference")
        for task, points in ends.items()
        if len(points) > 1
    }
    if words:
        lines.append(f"By reward, more data {on_tasks(words)}.")
    reached = [
        f"{_rate(list(curve.points.items())[-1])} on {curve.label.removesuffix(_PPO)}"
        for curve in ppo
    ]
    return lines + ([f"Success of PPO: {listed(reached)}."] if reached else [])


def _rate(point: tuple[int, EvalScores]) -> str:
    return f"{percent(point[1].success_rate)} ({steps_text(point[0])})"
