"""One model on the data of all tasks against one model per task (figure 6)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from egovcp.errors import UsageError
from egovcp.eval_scores import EvalScores
from egovcp_experiment import results
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.grid import ALL, REFERENCES, Grid, Model
from egovcp_experiment.report import (
    ExperimentReport,
    Plot,
    draw,
    listed,
    number,
    on_tasks,
    percent,
)

_LATENT_EPISODES: Final = 16  # per task
_REFERENCES: Final = (*REFERENCES, "constant")


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    if len(config.tasks) < 2:
        raise UsageError(
            f"--tasks=[{', '.join(config.tasks)}]: the model of a single task equals that of all; "
            "give at least two tasks"
        )
    page = ExperimentReport(
        "Multi-task: one model on mixed data against one for each task",
        sections=[_introduction(config)],
    )
    levels: dict[str, dict[str, float]] = {}
    both: dict[str, dict[str, EvalScores]] = {}
    epochs = Model("equal_epochs", {"steps": len(config.tasks) * config.train.steps})
    mixed = Model() if grid.given_policy(ALL) else epochs
    for task in config.tasks:
        plays = {
            "single": grid.plays(task, "single", trained_on=task),
            "mixed": grid.plays(task, "mixed", model=mixed),
        }
        scores = results.all_scores(records, plays, task)
        cell = grid.references(task, f"references-{task}", controllers=_REFERENCES)
        references = results.controller_scores(records, cell, task, _REFERENCES)
        page.metrics[task] = results.metrics_of({**scores, **references})
        if scores:
            page.sections.append(results.comparison(task, {**scores, **references}, "single"))
        if len(scores) == 2:
            both[task] = scores
        if {"oracle", "random"} <= references.keys():
            levels[task] = {name: _level(each, references) for name, each in scores.items()}
            page.metrics[task]["normalised"] = levels[task]
    if levels:
        page.plot = _levels_plot(levels)
    page.lead = _lead(both)
    episodes = min(config.play.episodes, _LATENT_EPISODES)
    flags = {"tasks": list(config.tasks), "episodes": episodes}
    cell = grid.sim_study("latents", ALL, flags, mixed)
    if cell in records:
        latents = records[cell]["metrics"]
        page.sections.append(_maps(latents))
        page.lead.append(_separation(latents))
        ticks = [number(latents[name]["tick_r2"], ".2f") for name in ("h", "z")]
        page.findings.append(
            f"The nearest states explain {ticks[0]} (h) and {ticks[1]} (z) of the variance of time "
            "within a task."
        )
        page.metrics["latents"] = {
            k: {n: latents[k][n] for n in ("same_task", "chance", "tick_r2")} for k in ("h", "z")
        }
    return page


def _introduction(config: ExperimentConfig) -> str:
    given = [task for task in (*config.tasks, ALL) if task in config.train.policies]
    existing = f" except those given for {', '.join(given)} (`--train.policies`)" if given else ""
    steps = config.train.steps
    return (
        f"Every model{existing} was trained for equally many epochs, as in the paper: {steps} "
        f"gradient steps on one task, {len(config.tasks) * steps} on the mixed data of "
        f"{len(config.tasks)} tasks. Its input does not name the task."
    )


def _level(scores: EvalScores, references: Mapping[str, EvalScores]) -> float:
    """Reward per step on a scale from the random walk (0) to the oracle (1)."""
    low, high = references["random"].reward_per_step, references["oracle"].reward_per_step
    return (scores.reward_per_step - low) / (high - low) if high != low else float("nan")


def _lead(scores: Mapping[str, Mapping[str, EvalScores]]) -> list[str]:
    """Success of both models, and how they compare by reward."""
    if not scores:
        return []
    gains = {task: row["mixed"].gain(row["single"]) for task, row in scores.items()}
    rates = [
        f"{percent(row['mixed'].success_rate)} of {task} (its own model "
        f"{percent(row['single'].success_rate)})"
        for task, row in scores.items()
    ]
    words = {t: gain.word(same="no different beyond chance") for t, gain in gains.items()}
    return [
        f"One model of all tasks succeeds in {listed(rates)}.",
        f"By reward, it is {on_tasks(words)}.",
    ]


def _levels_plot(levels: Mapping[str, Mapping[str, float]]) -> Plot:
    def paint(figure: Any) -> None:
        axes = figure.subplots()
        at = np.arange(len(levels))
        for k, name in enumerate(("single", "mixed")):
            heights = [row.get(name, float("nan")) for row in levels.values()]
            axes.bar(at + 0.35 * (k - 0.5), heights, 0.33, label=name)
        axes.axhline(1, color="0.6", linewidth=0.8, linestyle=":")
        axes.axhline(0, color="0.3", linewidth=0.8)
        axes.set_xticks(at, list(levels))
        axes.set_ylabel("reward, 0 random, 1 oracle")
        axes.legend(fontsize=8)

    return draw("normalised", "Reward per step: 0 a random walk, 1 the oracle", paint, (5.0, 3.0))


def _maps(latents: Mapping[str, Any]) -> Plot:
    task, tick = np.array(latents["task"]), np.array(latents["tick"])

    def paint(figure: Any) -> None:
        for (by_task, by_tick), name in zip(figure.subplots(2, 2), ("h", "z"), strict=True):
            points = np.array(latents[name]["map"])
            for i, label in enumerate(latents["tasks"]):
                by_task.scatter(*points[task == i].T, s=4, label=label, linewidths=0)
            shades = by_tick.scatter(*points.T, s=4, c=tick, cmap="viridis", linewidths=0)
            by_task.set_ylabel(name)
            by_task.legend(fontsize=7, markerscale=3)
            figure.colorbar(shades, ax=by_tick)
            for axes, title in ((by_task, "by task"), (by_tick, "by tick")):
                axes.set_title(title, fontsize=8)
                axes.set(xticks=[], yticks=[])

    caption = "t-SNE of h (above) and z (below) of the mixed model in closed loop"
    return draw("latents", caption, paint, (8.0, 6.5))


def _separation(latents: Mapping[str, Any]) -> str:
    h, z = latents["h"], latents["z"]
    return (
        "The nearest states of other episodes are of the same task in "
        f"{percent(h['same_task'])} (h) and {percent(z['same_task'])} (z) of cases, by chance in "
        f"{percent(h['chance'])}."
    )
