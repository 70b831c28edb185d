"""PPO, the model-free baseline, on the scenarios of the planner.

ppo-TASK-sSEED                        the training
play-TASK-ppo_TRANSITIONS-sSEED       a policy along it
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from egovcp.errors import UsageError
from egovcp.eval_scores import EvalScores
from egovcp.sim.config import evaluation_config
from egovcp_experiment import results
from egovcp_experiment.cell import PLAY, PPO_POLICY, TRAIN_PPO, Cell, CellOutput, ExternalPath
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.grid import BOUNDS, DEFAULT, Grid, Variant
from egovcp_experiment.report import ExperimentReport, Part, percent

SUMMARY: Final = "PPO, the model-free baseline, along its training, next to the planner"
_PLANNER: Final = "planner"


def ppo_plays(grid: Grid, task: str) -> dict[int, list[str]]:
    """Transitions -> names of the cells that play the policy, one per seed."""
    config = grid.config.ppo
    found: dict[int, list[str]] = {}
    for seed in grid.config.train.seeds:
        for k, transitions in enumerate(config.transitions):
            path = f"checkpoints/{config.updates * (k + 1):06d}/{PPO_POLICY}"
            policy = CellOutput(_training(grid, task, seed).name, path)
            flags = {**grid.scenarios(task), "controllers": "ppo", "ppo.path": policy}
            cell = grid.add(Cell(f"play-{task}-ppo_{transitions}-s{seed}", PLAY, flags))
            found.setdefault(transitions, []).append(cell.name)
    return found


def ppo_scores(grid: Grid, task: str, records: results.Records) -> dict[int, EvalScores]:
    """Transitions -> scores of PPO."""
    return results.all_scores(records, ppo_plays(grid, task), task, "ppo")


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
    """Planner ticks per episode of the collected data; the default for an existing dataset."""
    data = grid.data(task)
    if isinstance(data, ExternalPath) or data.cell not in records:
        return float(evaluation_config().episode(task).ticks)
    figures = records[data.cell]["figures"]
    return float(figures["steps"] / figures["episodes"])


def steps_text(count: int) -> str:
    """A number of transitions in words."""
    return f"{count / 1000:.0f}k steps" if count >= 10_000 else f"{count} steps"


def _plays(grid: Grid, task: str) -> list[str]:
    """Names of the planner's cells; adds those of PPO and the references."""
    names = grid.plays(task, Variant(DEFAULT))
    ppo_plays(grid, task)
    grid.bounds(task)
    return names


def cells(config: ExperimentConfig) -> list[Cell]:
    if not config.ppo.steps:
        raise UsageError("--ppo.steps=0 leaves PPO out; expected at least 1 here")
    grid = Grid(config)
    for task in config.tasks:
        _plays(grid, task)
    return grid.cells


def report(config: ExperimentConfig, records: results.Records) -> ExperimentReport:
    grid = Grid(config)
    shows: list[str] = []
    parts: list[Part] = [
        f"PPO was trained in the simulator for {config.ppo.transitions[-1]} transitions of each "
        "task, with the observation, actions, rewards, delays and noise of the planner, and played "
        f"as it was after {', '.join(map(str, config.ppo.transitions))}. The planner has its model "
        "from random data that were collected once. If its curve still rises at the end, PPO "
        "was stopped too early to be judged."
    ]
    figures: dict[str, Any] = {}
    for task in config.tasks:
        planner = results.eval_scores(records, _plays(grid, task), task)
        ppo = ppo_scores(grid, task, records)
        bounds = results.controller_scores(records, f"bounds-{task}", task, BOUNDS)
        ours = {} if planner is None else {_PLANNER: planner}
        shown = {**ours, **{f"PPO, {steps_text(n)}": s for n, s in ppo.items()}, **bounds}
        if ppo:
            episodes = getattr(config.data.episodes, task)
            offline = round(episodes * steps_per_episode(grid, task, records))
            curves = [results.Curve("PPO", ppo, "C1", "x--")]
            if planner is not None:
                curves.append(results.Curve(_PLANNER, {offline: planner}, "C0", "o"))
            caption = f"{task}: success and reward against transitions"
            parts.append(results.learning_curves(task, caption, curves))
            shows += _conclusions(task, offline, planner, ppo, bounds)
            figures[task] = {"planner_transitions": offline}
        if shown:
            parts.append(results.comparison(task, shown, _PLANNER))
            figures.setdefault(task, {}).update(results.figures_of(shown))
    title = "PPO, without a model, next to the planner"
    return ExperimentReport(title, tuple(shows), tuple(parts), figures)


def _conclusions(
    task: str,
    offline: int,
    planner: EvalScores | None,
    ppo: Mapping[int, EvalScores],
    bounds: Mapping[str, EvalScores],
) -> list[str]:
    count, last = list(ppo.items())[-1]
    lines = []
    if planner is not None:
        lines.append(
            f"{task}: the planner {percent(planner.success_rate)} success from "
            f"{steps_text(offline)}, PPO {percent(last.success_rate)} after {steps_text(count)}: "
            f"PPO is {_versus(last, planner)}"
        )
    if "hold" in bounds:
        lines.append(
            f"{task}: compared with the neutral pose, PPO is {_versus(last, bounds['hold'])}"
        )
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
