"""Searches in equal time, and other planner choices, with one model and the same scenarios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from egovcp.eval_scores import EvalScores
from egovcp_experiment import results
from egovcp_experiment.cell import CellFigure, Flags
from egovcp_experiment.grid import Grid
from egovcp_experiment.report import ExperimentReport, Table
from egovcp_experiment.studies.plan_time import SEARCHES

#: Rule -> flags of egovcp-eval; the search is the policy's own. ``default`` has
#: termination_rule=shift, action_parameterization=target and mirror=true, unless it was trained
#: with others.
RULES: Final[dict[str, Flags]] = {
    "default": {},
    "rule_paper": {"planner.termination_rule": "paper"},
    "rule_survival": {"planner.termination_rule": "survival"},
    "random_walk": {"planner.action_parameterization": "random_walk"},
    "latent_sample": {"planner.latent": "sample"},
    "no_mirror": {"planner.mirror": False},
}


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    page = ExperimentReport(
        "Planners: searches in equal time, and rules after a failure",
        sections=[
            "Searches: each has the largest number of candidates with a plan time below "
            f"{config.play.budget_ms:g} ms on the machine below; all searches were timed in turns. "
            "The number of elites is the planner's, at most half of the candidates. "
            "`cem_1` and `cem_6` are `cem` with 1 and 6 iterations instead of 3. "
            "Rules: the policy's own search."
        ],
    )
    chosen = config.chosen({**dict.fromkeys(SEARCHES), **dict.fromkeys(RULES)})
    for task in config.tasks:
        search_plays = _search_plays(grid, task, [name for name in SEARCHES if name in chosen])
        rule_plays = {
            name: grid.plays(task, name, flags) for name, flags in RULES.items() if name in chosen
        }
        searches = results.all_scores(records, search_plays, task)
        rules = results.all_scores(records, rule_plays, task)
        timing = records.get(f"plan_time-{task}")
        if timing is not None:
            timed = timing["figures"]["searches"]
            page.sections.append(_timings(task, timed, searches))
            page.findings += _over_budget(task, timed, searches, config.play.budget_ms)
        for kind, scores, reference in (("searches", searches, "cem"), ("rules", rules, "default")):
            if scores:
                title = f"{task}: {kind}"
                page.sections += [
                    results.comparison(title, scores, reference),
                    results.comparison_plot(f"{task}-{kind}", title, scores, reference),
                ]
                page.findings += _conclusions(task, kind, scores, reference)
        named = {f"search_{name}": each for name, each in searches.items()}
        page.figures[task] = results.figures_of({**named, **rules})
    return page


def _search_plays(grid: Grid, task: str, searches: Sequence[str]) -> dict[str, list[str]]:
    """Search -> names of its cells, one per training seed.

    One cell times the searches for all seeds: times depend on the networks' sizes alone.
    """
    plays = {}
    for name in searches:
        budget = {"budget_ms": grid.config.play.budget_ms}
        timing = grid.study("plan_time", task, budget, exclusive=True)
        options = ("optimiser", "iterations", "samples", "elites")
        flags = {f"planner.{o}": CellFigure(timing, ("searches", name, o)) for o in options}
        plays[name] = grid.plays(task, f"search_{name}", flags)
    return plays


def _timings(task: str, timed: Mapping[str, Any], played: Mapping[str, EvalScores]) -> Table:
    columns = ("samples", "iterations", "elites")
    rows = [
        (name, *(str(row[column]) for column in columns), f"{row['plan_ms']:.1f}")
        for name, row in timed.items()
        if name in played
    ]
    head = ("search", "candidates", "iterations", "elites", "plan (ms)")
    return Table(f"{task}: searches in equal time", head, rows)


def _over_budget(
    task: str, timed: Mapping[str, Any], played: Mapping[str, EvalScores], budget_ms: float
) -> list[str]:
    slow = [f"`{n}` {timed[n]['plan_ms']:.1f} ms" for n in played if not timed[n]["within_budget"]]
    if not slow:
        return []
    return [
        f"{task}, searches: above {budget_ms:g} ms even with the fewest candidates: "
        f"{', '.join(slow)}"
    ]


def _conclusions(
    task: str, kind: str, scores: Mapping[str, EvalScores], reference: str
) -> list[str]:
    if reference not in scores or len(scores) < 2:
        return []
    base = scores[reference]
    found = {name: each.gain(base) for name, each in scores.items() if each is not base}
    different = [
        f"`{n}` {gain.reward:+.4f}" for n, gain in found.items() if gain.word("+", "-", "")
    ]
    if different:
        return [
            f"{task}, {kind}: reward per step minus that of `{reference}`, intervals without "
            f"zero: {', '.join(different)}"
        ]
    return [
        f"{task}, {kind}: none of {len(scores) - 1} differs from `{reference}` "
        f"({base.success_rate:.0%} success) in reward by more than chance (95 %)"
    ]
