"""Searches on equal time, and other choices of a planner, with one model and the same scenarios."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from egovcp_experiment.cell import Cell, Flags, Found
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.experiment import Experiment
from egovcp_experiment.grid import Grid, Variant
from egovcp_experiment.outcomes import Outcome, outcome
from egovcp_experiment.report.comparison import comparison, gain_plot
from egovcp_experiment.report.document import Report, Table
from egovcp_experiment.store import Record
from egovcp_experiment.studies.plan_time import SEARCHES
from egovcp_experiment.tools import study

#: Rule -> flags of egovcp-eval; the search is the artifact's own.
RULES: Final[dict[str, Flags]] = {
    "default": {},
    "rule_paper": {"planner.termination_rule": "paper"},
    "rule_shift": {"planner.termination_rule": "shift"},
    "rule_survival": {"planner.termination_rule": "survival"},
    "random_walk": {"planner.action_parameterization": "random_walk"},
    "target": {"planner.action_parameterization": "target"},
    "latent_sample": {"planner.latent": "sample"},
}
_REFERENCE: Final = "cem"


def _search(name: str, timing: str) -> Variant:
    """A search with as many candidates as it affords."""
    options = ("optimiser", "iterations", "samples", "elites")
    flags = {f"planner.{o}": Found(timing, ("searches", name, o)) for o in options}
    return Variant(f"search_{name}", play=flags)


def _names(config: ExperimentConfig) -> tuple[list[str], list[str]]:
    """The searches and the rules that are asked for."""
    chosen = config.chosen({**dict.fromkeys(SEARCHES), **dict.fromkeys(RULES)})
    return [n for n in SEARCHES if n in chosen], [n for n in RULES if n in chosen]


def _timing(grid: Grid, task: str) -> Cell:
    """The candidates depend on the networks' sizes alone: one model is timed for all seeds."""
    policy = grid.model(task, grid.config.train.seeds[0])
    flags = {**grid.planner(task), "policy.path": policy, "budget_ms": grid.config.play.budget_ms}
    return grid.add(Cell(f"plan_time-{task}", study("plan_time", alone=True), flags))


def _plays(config: ExperimentConfig, grid: Grid, task: str) -> dict[str, list[str]]:
    """Search or rule -> names of its cells, one for each seed."""
    searches, rules = _names(config)
    seeds = config.train.seeds
    for seed in seeds:
        grid.model(task, seed)
    timing = _timing(grid, task).name if searches else ""
    variants = [_search(name, timing) for name in searches]
    variants += [Variant(name, play=RULES[name]) for name in rules]
    return {v.name: [grid.play(task, seed, v).name for seed in seeds] for v in variants}


def _cells(config: ExperimentConfig) -> list[Cell]:
    grid = Grid(config)
    for task in config.tasks:
        _plays(config, grid, task)
    return grid.cells


def _report(config: ExperimentConfig, records: Mapping[str, Record]) -> Report:
    grid = Grid(config)
    shows: list[str] = []
    parts: list[Any] = [
        f"Searches: each weighs as many candidates as a plan of one robot affords in "
        f"{config.play.budget_ms:g} ms on the machine below, by a timing of all of them in turns. "
        "Elites are as many as the planner has, and at most half of the candidates. "
        "`cem_1` and `cem_6` are `cem` with that many rounds instead of 3. "
        "Rules: the artifact's own search."
    ]
    figures: dict[str, Any] = {}
    for task in config.tasks:
        found = {
            name: played
            for name, cells in _plays(config, grid, task).items()
            if (played := outcome(records, cells, task)) is not None
        }
        searches = {k.removeprefix("search_"): v for k, v in found.items() if k not in RULES}
        rules = {k: v for k, v in found.items() if k in RULES}
        timing = records.get(f"plan_time-{task}")
        if timing is not None:
            parts.append(_timings(task, timing["figures"]["searches"], searches))
        for kind, outcomes, reference in (
            ("searches", searches, _REFERENCE),
            ("rules", rules, "default"),
        ):
            if outcomes:
                parts.append(comparison(f"{task}: {kind}", outcomes, reference))
                parts.append(gain_plot(f"{task}-{kind}", f"{task}: {kind}", outcomes, reference))
                shows += _shows(task, kind, outcomes, reference)
        figures[task] = {name: played.figures() for name, played in found.items()}
    return Report(
        "Planners: searches on equal time, and rules after a failure",
        tuple(shows),
        tuple(parts),
        figures,
    )


def _timings(task: str, timed: Mapping[str, Any], played: Mapping[str, Outcome]) -> Table:
    rows = tuple(
        (
            name,
            str(row["samples"]),
            str(row["iterations"]),
            str(row["elites"]),
            f"{row['plan_ms']:.1f}",
        )
        for name, row in timed.items()
        if name in played
    )
    head = ("search", "candidates a round", "rounds", "elites", "plan (ms)")
    return Table(f"{task}: what the searches afford", head, rows)


def _shows(task: str, kind: str, outcomes: Mapping[str, Outcome], reference: str) -> list[str]:
    if reference not in outcomes or len(outcomes) < 2:
        return []
    base = outcomes[reference]
    apart = {}
    for name, played in outcomes.items():
        gain, (low, high) = played.reward_gain(base)
        if name != reference and (low > 0 or high < 0):
            apart[name] = gain
    if not apart:
        return [
            f"{task}, {kind}: none of {len(outcomes) - 1} differs from `{reference}` "
            f"({base.success_rate:.0%} success) in reward by more than chance (95 %)"
        ]
    words = ", ".join(f"`{name}` {gain:+.4f}" for name, gain in apart.items())
    return [
        f"{task}, {kind}: reward per step beside `{reference}`, intervals without zero: {words}"
    ]


EXPERIMENT: Final = Experiment(
    "CEM, iCEM, MPPI and random shooting on equal time; the rules after a failure", _cells, _report
)
