"""Searches in equal time, and single options of the planner, on the same scenarios."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from egovcp.eval_scores import EvalScores, Gain
from egovcp_experiment import results
from egovcp_experiment.cell import CellMetric, Flags
from egovcp_experiment.gain_plot import Difference, gain_plot
from egovcp_experiment.grid import Grid
from egovcp_experiment.report import ExperimentReport, Table
from egovcp_experiment.studies.plan_time import SEARCHES

#: Option -> flags of egovcp-eval; the search is the policy's own. ``default`` has
#: termination_rule=shift, action_parameterization=target and mirror=true, unless it was trained
#: with others.
OPTIONS: Final[dict[str, Flags]] = {
    "default": {},
    "rule_paper": {"planner.termination_rule": "paper"},
    "rule_survival": {"planner.termination_rule": "survival"},
    "random_walk": {"planner.action_parameterization": "random_walk"},
    "latent_sample": {"planner.latent": "sample"},
    "no_mirror": {"planner.mirror": False},
}


#: Kind of variants -> the one that the others are compared with.
_REFERENCE: Final = {"searches": "cem", "options": "default"}

type VariantScores = Mapping[str, EvalScores]
"""Variant -> scores."""


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    page = ExperimentReport(
        "Planners: searches in equal time, and single options of the planner",
        sections=[
            "Searches: each has the largest number of candidates with a plan time below "
            f"{config.play.budget_ms:g} ms on the machine below; all searches were timed in turns. "
            "The number of elites is the planner's, at most half of the candidates. "
            "`cem_1` and `cem_6` are `cem` with 1 and 6 iterations instead of 3. "
            "Options: the policy's own search."
        ],
    )
    chosen = config.chosen({**dict.fromkeys(SEARCHES), **dict.fromkeys(OPTIONS)})
    found: dict[str, dict[str, VariantScores]] = {kind: {} for kind in _REFERENCE}
    for task in config.tasks:
        search_plays = _search_plays(grid, task, [name for name in SEARCHES if name in chosen])
        option_plays = {
            name: grid.plays(task, name, flags) for name, flags in OPTIONS.items() if name in chosen
        }
        searches = results.all_scores(records, search_plays, task)
        options = results.all_scores(records, option_plays, task)
        timing = records.get(f"plan_time-{task}")
        if timing is not None:
            timed = timing["metrics"]["searches"]
            page.sections.append(_timings(task, timed, searches))
            page.findings += _over_budget(task, timed, searches, config.play.budget_ms)
        for kind, scores in (("searches", searches), ("options", options)):
            if scores:
                title = f"{task}: {kind}"
                page.sections.append(results.comparison(title, scores, _REFERENCE[kind]))
                found[kind][task] = scores
        named = {f"search_{name}": each for name, each in searches.items()}
        page.metrics[task] = results.metrics_of({**named, **options})
    gains = {kind: _gains(kind, scores) for kind, scores in found.items()}
    if any(found["searches"].values()):
        best = ", ".join(
            f"`{max(scores, key=lambda name: scores[name].reward_per_step)}` ({task})"
            for task, scores in found["searches"].items()
        )
        page.lead.append(f"In {config.play.budget_ms:g} ms a plan, the most reward has {best}.")
    page.lead += [_differing(kind, each) for kind, each in gains.items() if each]
    panels: dict[str, dict[str, Difference]] = {}
    for each, colour in zip(gains.values(), ("C0", "C1"), strict=True):
        for task, row in each.items():
            shown = {n: Difference(g.reward, g.reward_interval, colour) for n, g in row.items()}
            panels.setdefault(task, {}).update(shown)
    if panels:
        caption = "Reward per step above `cem` (searches, blue) or `default` (options, orange)"
        page.plot = gain_plot("gains", caption, panels, "reward per step")
    return page


def _gains(kind: str, found: Mapping[str, VariantScores]) -> dict[str, dict[str, Gain]]:
    """Task -> variant -> gain over the reference; without tasks that lack it."""
    reference = _REFERENCE[kind]
    return {
        task: {n: each.gain(scores[reference]) for n, each in scores.items() if n != reference}
        for task, scores in found.items()
        if reference in scores and len(scores) > 1
    }


def _differing(kind: str, gains: Mapping[str, Mapping[str, Gain]]) -> str:
    """The variants whose reward differs from that of the reference by more than chance."""
    words = [
        f"`{name}` is {word} at {task}"
        for task, row in gains.items()
        for name, gain in row.items()
        if (word := gain.word(same=""))
    ]
    return (
        f"Of the {kind}, compared with `{_REFERENCE[kind]}` by reward (95 % each): "
        f"{', '.join(words) or 'none differs'}."
    )


def _search_plays(grid: Grid, task: str, searches: Sequence[str]) -> dict[str, list[str]]:
    """Search -> names of its cells, one per training seed.

    One cell times the searches for all seeds: times depend on the networks' sizes alone.
    """
    plays = {}
    for name in searches:
        budget = {"budget_ms": grid.config.play.budget_ms}
        timing = grid.study("plan_time", task, budget, exclusive=True)
        options = ("optimiser", "iterations", "samples", "elites")
        flags = {f"planner.{o}": CellMetric(timing, ("searches", name, o)) for o in options}
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
