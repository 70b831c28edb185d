"""PPO, the model-free baseline, on the scenarios of the planner.

ppo-TASK-sSEED                        the training
play-TASK-ppo_TRANSITIONS-sSEED       a policy along it
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from egovcp.errors import UsageError
from egovcp.eval_scores import EvalScores
from egovcp.sim.config import short_episodes
from egovcp_experiment import results
from egovcp_experiment.cell import PLAY, PPO_POLICY, TRAIN_PPO, Cell, CellOutput, ExternalPath
from egovcp_experiment.grid import REFERENCES, Grid
from egovcp_experiment.report import ExperimentReport, percent

_PLANNER: Final = "planner"


def ppo_scores(grid: Grid, task: str, records: results.Records) -> dict[int, EvalScores]:
    """Transitions -> scores of the policy; none with ``--ppo.steps=0``."""
    config = grid.config.ppo
    plays: dict[int, list[str]] = {}
    for seed in grid.config.train.seeds:
        for k, transitions in enumerate(config.transitions):
            path = f"checkpoints/{config.updates * (k + 1):06d}/{PPO_POLICY}"
            policy = CellOutput(_training(grid, task, seed).name, path)
            flags = {**grid.scenarios(task), "controllers": "ppo", "ppo.path": policy}
            cell = grid.add(Cell(f"play-{task}-ppo_{transitions}-s{seed}", PLAY, flags))
            plays.setdefault(transitions, []).append(cell.name)
    return results.all_scores(records, plays, task, "ppo")


def _training(grid: Grid, task: str, seed: int) -> Cell:
    config = grid.config.ppo
    flags = {
        "task": task,
        "steps": config.transitions[-1],
        "robots": config.robots,
        "ppo.num_steps_per_env": config.ticks,
        "save_freq": config.updates,
        "seed": seed,
    }
    extra = (*grid.config.scenes, *config.flags)
    return grid.add(Cell(f"ppo-{task}-s{seed}", TRAIN_PPO, flags, extra))


def steps_per_episode(grid: Grid, task: str, records: results.Records) -> float:
    """Planner ticks per episode of the data; the default of a collection without a result."""
    data = grid.data(task)
    if isinstance(data, ExternalPath):
        episodes, transitions = grid.given_size(task)
        return transitions / episodes
    if data.cell not in records:
        return float(short_episodes().episode(task).ticks)
    figures = records[data.cell]["figures"]
    return float(figures["steps"] / figures["episodes"])


def steps_text(count: int) -> str:
    """A number of transitions in words."""
    return f"{count / 1000:.0f}k steps" if count >= 10_000 else f"{count} steps"


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    if not config.ppo.steps:
        raise UsageError("--ppo.steps=0 leaves PPO out; expected at least 1 here")
    page = ExperimentReport(
        "PPO, without a model, next to the planner",
        sections=[
            f"PPO was trained in the simulator for {config.ppo.transitions[-1]} transitions of "
            "each task, with the observation, actions, rewards, delays and noise of the planner, "
            f"and played as it was after {', '.join(map(str, config.ppo.transitions))}. The "
            "planner has its model from random data that were collected once. If its curve still "
            "rises at the end, PPO was stopped too early to be judged."
        ],
    )
    for task in config.tasks:
        planner = results.eval_scores(records, grid.plays(task), task)
        ppo = ppo_scores(grid, task, records)
        cell = grid.references(task)
        references = results.controller_scores(records, cell, task, REFERENCES)
        ours = {} if planner is None else {_PLANNER: planner}
        shown = {**ours, **{f"PPO, {steps_text(n)}": s for n, s in ppo.items()}, **references}
        if ppo:
            offline = None  # unknown for a given policy
            if not grid.given_policy(grid.trained_on):
                offline = round(grid.episodes(task) * steps_per_episode(grid, task, records))
            curves = [results.Curve("PPO", ppo, "C1", "x--")]
            if planner is not None and offline is not None:
                curves.append(results.Curve(_PLANNER, {offline: planner}, "C0", "o"))
            caption = f"{task}: success and reward against transitions"
            page.sections.append(results.learning_curves(task, caption, curves))
            page.findings += _conclusions(task, offline, planner, ppo, references)
            page.figures[task] = {} if offline is None else {"planner_transitions": offline}
        if shown:
            page.sections.append(results.comparison(task, shown, _PLANNER))
            page.figures.setdefault(task, {}).update(results.figures_of(shown))
    return page


def _conclusions(
    task: str,
    offline: int | None,
    planner: EvalScores | None,
    ppo: Mapping[int, EvalScores],
    references: Mapping[str, EvalScores],
) -> list[str]:
    count, last = list(ppo.items())[-1]
    lines = []
    if planner is not None:
        seen = "" if offline is None else f" from {steps_text(offline)}"
        lines.append(
            f"{task}: the planner {percent(planner.success_rate)} success{seen}, PPO "
            f"{percent(last.success_rate)} after {steps_text(count)}: PPO is "
            f"{_versus(last, planner)}"
        )
    if "hold" in references:
        versus = _versus(last, references["hold"])
        lines.append(f"{task}: compared with the neutral pose, PPO is {versus}")
    if len(ppo) > 1:
        first = next(iter(ppo.values()))
        lines.append(
            f"{task}: compared with its first policy, PPO's last is {_versus(last, first)}"
        )
    return lines


def _versus(scores: EvalScores, other: EvalScores) -> str:
    """Better or worse by reward, which PPO is trained on."""
    gain = scores.gain(other)
    return f"{gain.word(same='no different beyond chance')} ({gain})"
