"""Success and reward against the transitions that a model has seen (figure 5), and against the
gradient steps of its training.

Models of all tasks are trained equally long on growing first parts of the data. Those of the whole
data are also played as they were during their training.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from egovcp.errors import UsageError
from egovcp.eval_scores import EvalScores
from egovcp_experiment import results
from egovcp_experiment.cell import Flags
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.experiments.ppo import (
    LIMITS,
    count_text,
    ppo_scores,
    steps_per_episode,
)
from egovcp_experiment.grid import REFERENCES, Grid, Model, parse_flags
from egovcp_experiment.report import ExperimentReport, listed, on_tasks, percent

_PPO: Final = ", PPO"
#: Default of ``egovcp-train --save_freq``.
SAVE_FREQ: Final = 1000
_DURING: Final = 3  # policies played before the end of a training, at most


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    _require_parts(config)
    grid.collected = max(1.0, *config.data.parts)
    page = ExperimentReport(
        "Scaling: success against transitions and gradient steps",
        sections=[_introduction(config)],
    )
    data: list[results.Curve] = []
    ppo_curves: list[results.Curve] = []
    training: list[results.Curve] = []
    models = {part: _model(grid, part) for part in sorted(config.data.parts)}
    for k, task in enumerate(config.tasks):
        plays = {part: grid.plays(task, m.name, model=m) for part, m in models.items()}
        references = grid.references(task)
        ppo = ppo_scores(grid, task, records)
        during = results.all_scores(records, _plays_during_training(grid, task), task)
        scores = results.all_scores(records, plays, task)
        length = steps_per_episode(grid, task, records)
        sizes = {round(grid.episodes(task, part) * length): s for part, s in scores.items()}
        colour = f"C{k}"
        if sizes:
            data.append(results.Curve(task, sizes, colour))
        if ppo:
            ppo_curves.append(results.Curve(task + _PPO, ppo, colour, "x--"))
        if during:
            training.append(results.Curve(task, during, colour))
        shown = {f"{count_text(size)} transitions": each for size, each in sizes.items()}
        last = list(shown)[-1:]
        shown |= {f"PPO, {count_text(n)} transitions": each for n, each in ppo.items()}
        shown |= {f"after {n} gradient steps": each for n, each in during.items()}
        if shown:
            shown |= results.controller_scores(records, references, task, REFERENCES)
            page.sections.append(results.comparison(task, shown, "".join(last)))
            page.metrics[task] = results.metrics_of(shown)
    panels = {"transitions": data + ppo_curves, "gradient steps": training}
    panels = {label: curves for label, curves in panels.items() if curves}
    if panels:
        caption = f"Success and reward against {listed(list(panels))}"
        page.plot = results.learning_curves("scaling", caption, panels)
    page.lead = [
        *_lead(data, "data", "transitions"),
        *_lead(training, "gradient steps", "steps"),
        *_ppo_lead(ppo_curves),
    ]
    return page


def _require_parts(config: ExperimentConfig) -> None:
    """Refuse more than all of a given dataset."""
    given = sorted(set(config.data.roots) & set(config.tasks))
    if max(config.data.parts) > 1 and given:
        parts = [part for part in config.data.parts if part <= 1] or [1.0]
        raise UsageError(
            f"--data.parts={list(config.data.parts)}: parts of the dataset given for {given[0]} "
            f"(--data.roots) are at most 1; give --data.parts={parts}"
        )


def _introduction(config: ExperimentConfig) -> str:
    text = (
        f"Every model was trained for the same number of gradient steps ({config.train.steps}) on "
        "growing first parts of the data; a twentieth of each part is held out. Transitions are "
        "those of one task. The curve of gradient steps is of checkpoints of the default model, "
        "whose learning rate had not yet fallen to its end."
    )
    if config.ppo.transitions:
        count = len(config.train.seeds)
        text += (
            " The model-free baseline (PPO, dashed) learns one task and collects its transitions "
            f"while it learns; its curve is that of {count} training{'s' * (count > 1)}. {LIMITS}"
        )
    return text


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


def _plays_during_training(grid: Grid, task: str) -> dict[int, list[str]]:
    """Gradient steps -> plays of the model of all episodes; none unless this trains it."""
    whole = _model(grid, 1.0)
    if 1.0 not in grid.config.data.parts or grid.given_policy(grid.trained_on):
        return {}
    total = grid.config.train.steps
    each = int(parse_flags(grid.config.train.flags).get("save_freq", SAVE_FREQ))
    parts = [k * total // (_DURING + 1) // each * each for k in range(1, _DURING + 1)]
    steps = sorted({step for step in parts if step > 0})
    found = {n: grid.plays(task, f"step_{n}", model=replace(whole, step=n)) for n in steps}
    return found | ({total: grid.plays(task, whole.name, model=whole)} if found else {})


def _lead(curves: Sequence[results.Curve], more: str, unit: str) -> list[str]:
    """Success of the first and the last model of each curve, and their difference in reward."""
    ends = {curve.label: list(curve.points.items()) for curve in curves}
    rates = []
    for task, points in ends.items():
        first_and_last = dict((points[0], points[-1])).items()
        rates.append(f"{' to '.join(_rate(*point, unit) for point in first_and_last)} on {task}")
    words = {
        task: points[-1][1].gain(points[0][1]).word(same="no different beyond chance")
        for task, points in ends.items()
        if len(points) > 1
    }
    lines = [f"Success with more {more}: {listed(rates)}."] if rates else []
    if words:
        lines.append(f"By reward, the model with most {more} is {on_tasks(words)} than the first.")
    return lines


def _ppo_lead(curves: Sequence[results.Curve]) -> list[str]:
    ends = {curve.label.removesuffix(_PPO): list(curve.points.items())[-1] for curve in curves}
    reached = [f"{_rate(*end, 'transitions')} on {task}" for task, end in ends.items()]
    return [f"Success of PPO: {listed(reached)}."] if reached else []


def _rate(count: int, scores: EvalScores, unit: str) -> str:
    return f"{percent(scores.success_rate)} ({count_text(count)} {unit})"
