"""The model-free baseline on the scenarios of the planner."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from egovcp.errors import UsageError
from egovcp_experiment import model_free
from egovcp_experiment.cell import Cell
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.experiment import Experiment
from egovcp_experiment.grid import BOUNDS, Grid, Variant
from egovcp_experiment.outcomes import Outcome, outcome, side_by_side
from egovcp_experiment.report.comparison import comparison
from egovcp_experiment.report.curves import Curve, transitions_plot
from egovcp_experiment.report.document import Plot, Report, Table, percent, points_range
from egovcp_experiment.store import Record
from egovcp_experiment.transitions import per_episode, steps

_PLANNER: Final = "planner"


def _plays(config: ExperimentConfig, grid: Grid, task: str) -> list[str]:
    """Names of the planner's cells, one for each seed; PPO's and the references' beside them."""
    cells = [grid.play(task, seed, Variant("default")).name for seed in config.train.seeds]
    model_free.plays(grid, task)
    grid.bounds(task)
    return cells


def _cells(config: ExperimentConfig) -> list[Cell]:
    if not config.ppo.steps:
        raise UsageError("--ppo.steps=0 leaves PPO out; expected at least 1 here")
    grid = Grid(config)
    for task in config.tasks:
        _plays(config, grid, task)
    return grid.cells


def _report(config: ExperimentConfig, records: Mapping[str, Record]) -> Report:
    grid = Grid(config)
    shows: list[str] = []
    parts: list[str | Table | Plot] = [_training(config)]
    figures: dict[str, Any] = {}
    for task in config.tasks:
        planner = outcome(records, _plays(config, grid, task), task)
        free = model_free.curve(grid, task, records)
        others = side_by_side(records, f"bounds-{task}", task, BOUNDS)
        ours = {} if planner is None else {_PLANNER: planner}
        named = {f"PPO, {steps(seen)}": played for seen, played in free.items()}
        shown = {**ours, **named, **others}
        if free:
            episodes = getattr(config.data.episodes, task)
            offline = round(episodes * per_episode(grid, task, records))
            curve = {offline: planner} if planner is not None else {}
            parts.append(_plot(task, curve, free))
            shows += _shows(task, curve, free, others)
            figures[task] = {"planner_transitions": offline}
        if shown:
            parts.append(comparison(task, shown, _PLANNER))
            figures.setdefault(task, {}).update({k: o.figures() for k, o in shown.items()})
    title = "PPO, without a model, beside the planner"
    return Report(title, tuple(shows), tuple(parts), figures)


def _training(config: ExperimentConfig) -> str:
    last = config.ppo.transitions[-1] if config.ppo.steps else 0
    return (
        f"PPO was trained in the simulator for {last} transitions of each task, with the "
        "observation, actions, rewards, delays and noise of the planner, and played as it was "
        f"after {', '.join(map(str, config.ppo.transitions))}. The planner has its model from "
        "random data that were collected once. A curve that still rises at its end says that PPO "
        "was stopped too early to be judged, and no more."
    )


def _shows(
    task: str,
    planner: Mapping[int, Outcome],
    free: Mapping[int, Outcome],
    others: Mapping[str, Outcome],
) -> list[str]:
    seen, last = list(free.items())[-1]
    lines = []
    for offline, played in planner.items():
        lines.append(
            f"{task}: the planner {percent(played.success_rate)} success from {steps(offline)}, "
            f"PPO {percent(last.success_rate)} after {steps(seen)}: PPO is "
            f"{_beside(last, played)}"
        )
    if "hold" in others:
        lines.append(f"{task}: beside the neutral pose, PPO is {_beside(last, others['hold'])}")
    first = next(iter(free.values()))
    if len(free) > 1:
        lines.append(f"{task}: beside its first policy, PPO's last is {_beside(last, first)}")
    return lines


def _beside(played: Outcome, other: Outcome) -> str:
    """Better or worse by reward, which PPO is trained on; success beside it."""
    reward, (low, high) = played.reward_gain(other)
    success, interval = played.success_gain(other)
    word = "better" if low > 0 else "worse" if high < 0 else "no different beyond chance"
    return (
        f"{word} (reward per step {reward:+.5f}, 95 % {low:+.5f} to {high:+.5f}; success "
        f"{100 * success:+.1f} points, {points_range(interval)})"
    )


def _plot(task: str, planner: Mapping[int, Outcome], free: Mapping[int, Outcome]) -> Plot:
    curves = [Curve("PPO", free, "C1", "x--")]
    if planner:
        curves.append(Curve(_PLANNER, planner, "C0", "o"))
    return transitions_plot(task, f"{task}: success and reward against transitions", curves)


EXPERIMENT: Final = Experiment(
    "PPO, the model-free baseline, along its training beside the planner", _cells, _report
)
