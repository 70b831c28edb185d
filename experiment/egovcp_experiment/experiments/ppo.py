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
from egovcp_experiment.report import ExperimentReport, listed, on_tasks, percent

#: What the planner's model has, and PPO does not.
LIMITS: Final = "PPO's critic gets no privileged state, and its samples are not mirrored."
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
    metrics = records[data.cell]["metrics"]
    return float(metrics["steps"] / metrics["episodes"])


def count_text(count: int) -> str:
    """A number, rounded to thousands if it is large: ``500k``."""
    return f"{count / 1000:.0f}k" if count >= 10_000 else str(count)


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    if not config.ppo.steps:
        raise UsageError("--ppo.steps=0 leaves PPO out; expected at least 1 here")
    page = ExperimentReport(
        "PPO, without a model, next to the planner",
        sections=[
            f"PPO was trained in the simulator for {config.ppo.transitions[-1]} transitions of "
            "each task, with the observation, actions, rewards, delays and noise of the planner, "
            f"and played as it was after {', '.join(map(str, config.ppo.transitions))}. {LIMITS} "
            "The planner has its model from random data that were collected once. If PPO's curve "
            "still rises at the end, it was stopped too early to be judged."
        ],
    )
    curves: list[results.Curve] = []
    last: dict[str, EvalScores] = {}
    planners: dict[str, EvalScores] = {}
    for k, task in enumerate(config.tasks):
        planner = results.eval_scores(records, grid.plays(task), task)
        ppo = ppo_scores(grid, task, records)
        cell = grid.references(task)
        references = results.controller_scores(records, cell, task, REFERENCES)
        if planner is not None:
            planners[task] = planner
        if ppo:
            last[task] = list(ppo.values())[-1]
            curves.append(results.Curve(f"{task}, PPO", ppo, f"C{k}", "x--"))
            page.findings += _conclusions(task, ppo, references)
            page.metrics[task] = {}
            if not grid.given_policy(grid.trained_on):  # else its transitions are unknown
                offline = round(grid.episodes(task) * steps_per_episode(grid, task, records))
                page.metrics[task]["planner_transitions"] = offline
                if planner is not None:
                    curves.append(results.Curve(task, {offline: planner}, f"C{k}", "o"))
        ours = {} if planner is None else {_PLANNER: planner}
        shown = {
            **ours,
            **{f"PPO, {count_text(n)} transitions": s for n, s in ppo.items()},
            **references,
        }
        if shown:
            page.sections.append(results.comparison(task, shown, _PLANNER))
            page.metrics.setdefault(task, {}).update(results.metrics_of(shown))
    if curves:
        caption = "PPO (dashed) and the planner (dots): success and reward against transitions"
        page.plot = results.learning_curves("transitions", caption, {"transitions": curves})
    if planners:
        page.lead.append(f"The planner succeeds in {_rates(planners)}.")
    if last:
        after = f"{count_text(config.ppo.transitions[-1])} transitions"
        page.lead.append(f"PPO succeeds in {_rates(last)} after {after}.")
    both = {task: _word(each, planners[task]) for task, each in last.items() if task in planners}
    if both:
        page.lead.append(f"By reward, compared with the planner, PPO is {on_tasks(both)}.")
    return page


def _rates(scores: Mapping[str, EvalScores]) -> str:
    return listed([f"{percent(each.success_rate)} of {task}" for task, each in scores.items()])


def _conclusions(
    task: str, ppo: Mapping[int, EvalScores], references: Mapping[str, EvalScores]
) -> list[str]:
    policies = list(ppo.values())
    first, last = policies[0], policies[-1]
    others = {"the neutral pose": references.get("hold"), "its first policy": first}
    words = [
        f"{_word(last, other)} compared with {name}"
        for name, other in others.items()
        if other is not None and other is not last
    ]
    return [f"{task}: by reward, the last policy of PPO is {listed(words)}."] if words else []


def _word(scores: EvalScores, other: EvalScores) -> str:
    """Better or worse by reward, which PPO is trained on."""
    return scores.gain(other).word(same="no different beyond chance")
