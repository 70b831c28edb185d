"""Whether errors of Q along a plan average out and predict the best horizon (section III-D)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from egovcp.eval_scores import EvalScores, signed_range
from egovcp.spec import ACTION_ETA
from egovcp_experiment import results
from egovcp_experiment.grid import Grid, parse_flags
from egovcp_experiment.report import ExperimentReport, Plot, Table, draw
from egovcp_experiment.studies.residuals import STEPS

_HORIZONS: Final = tuple(range(1, STEPS + 1))
#: The random walk of `egovcp-collect` by default and of its preset `paper`, as flags.
_COLLECT_WALK: Final = {"eta": "1.0", "step_ticks": "[5,15]", "boundary": "reflect"}
_PAPER_WALK: Final = {"eta": str(ACTION_ETA), "step_ticks": "[1,1]", "boundary": "reflect"}
_PLANS: Final = {"planner": "plans that the planner chose", "random": "random plans"}


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    given = parse_flags(config.data.flags)
    walk = _PAPER_WALK if given.get("preset") == "paper" else _COLLECT_WALK
    walk = walk | {name: given[name] for name in _COLLECT_WALK if name in given}
    page = ExperimentReport(
        "Variance: do the errors of Q along a plan average out?",
        sections=[
            "Residuals are Q along an imagined plan minus the mean return of random walks that the "
            "simulator takes from the same step of the same plan; the variance of that mean is "
            "taken off. Bounds use the largest correlation between two steps and the least and "
            "largest variance, as in the paper. `cutting`: returns as in training minus returns to "
            "the end of the episode. By default Q is trained on the privileged value of planned "
            "actions, not on returns of random walks: only for models trained with "
            "`--policy.loss.q_target=mc` does the comparison test the paper's claim."
        ],
    )
    for task in config.tasks:
        flags = {"task": task, "episodes": config.play.episodes, "branches": config.play.branches}
        cell = grid.sim_study("residuals", task, {**flags, **walk})
        plays = {n: grid.plays(task, f"horizon_{n}", {"planner.horizon": n}) for n in _HORIZONS}
        scores = results.all_scores(records, plays, task)
        page.figures[task] = {"horizons": results.figures_of(scores)}
        if cell in records:
            plans = records[cell]["figures"]["plans"]
            page.figures[task]["residuals"] = plans
            known = {kind: row for kind, row in plans.items() if "horizons" in row}
            page.sections += [_table(task, kind, row) for kind, row in known.items()]
            if known and scores:
                page.sections.append(_plot(task, known, scores))
            page.findings += _conclusions(task, known, scores)
        if scores:
            rows = {f"N = {n}": each for n, each in scores.items()}
            page.sections.append(results.comparison(f"{task}: closed loop", rows, "N = 4"))
        play = {"task": task, "episodes": config.play.episodes}
        cell = grid.sim_study("plan_terms", task, play)
        if cell in records:
            _add_terms(page, task, records[cell]["figures"])
    return page


def _add_terms(page: ExperimentReport, task: str, found: Mapping[str, Any]) -> None:
    """The mean of Q over a plan next to its first and its last term alone."""
    scores = {
        term: EvalScores(
            np.array([row["reward"]]), np.array([row["steps"]]), np.array([row["success"]], float)
        )
        for term, row in found["terms"].items()
    }
    title = f"{task}: plans of N = {found['horizon']}, chosen by the mean of Q or by one term"
    page.sections.append(results.comparison(title, scores, "mean"))
    spread = ", ".join(f"{value / found['return_std']:.2f}" for value in found["spread"])
    alone = ", ".join(
        f"{term} term {scores[term].gain(scores['mean']).word()} ({scores[term].success_rate:.1%})"
        for term in ("first", "last")
    )
    page.findings.append(
        f"{task}: compared with the mean of Q over a plan ({scores['mean'].success_rate:.1%}), by "
        f"reward: {alone}; over random plans the terms have standard deviations of {spread} of "
        "that of the return"
    )
    page.figures[task]["terms"] = {**results.figures_of(scores), "spread": found["spread"]}


def _table(task: str, kind: str, row: Mapping[str, Any]) -> Table:
    rows = [
        (
            str(at["n"]),
            f"{row['sigma'][k]:.4f}",
            f"{row['bias'][k]:+.4f}",
            f"{row['bias_of_cutting'][k]:+.4f}",
            f"{at['variance']:.5f}",
            f"{at['v_lb']:.5f}",
            f"{at['v_ub']:.5f}",
            f"{at['bias']:+.4f}",
            f"{at['error']:.5f}",
        )
        for k, at in enumerate(row["horizons"])
    ]
    head = (
        *("N", "sigma of step N-1", "its bias", "cutting", "Var of J_N's error"),
        *("V_lb", "V_ub", "bias of J_N", "mean square"),
    )
    title = f"{task}, {_PLANS[kind]} ({row['plans']}; largest correlation {row['rho_max']:.2f})"
    return Table(title, head, rows)


def _conclusions(
    task: str, plans: Mapping[str, Mapping[str, Any]], scores: Mapping[int, EvalScores]
) -> list[str]:
    lines = []
    for kind, row in plans.items():
        one, four = row["horizons"][0], row["horizons"][3]
        share = four["variance"] / one["variance"] if one["variance"] > 0 else math.nan
        lines.append(
            f"{task}, {_PLANS[kind]}: errors of neighbouring steps correlate by "
            f"{row['rho_next']:.2f} (largest {row['rho_max']:.2f}); averaging over N = 4 leaves "
            f"{share:.0%} of the variance of N = 1, where independent errors would leave 25 %"
        )
    if plans and len(scores) == len(_HORIZONS):
        row = plans.get("planner") or next(iter(plans.values()))
        predicted = min(row["horizons"], key=lambda at: at["error"])["n"]
        best = max(scores, key=lambda n: scores[n].reward_per_step)
        gain = scores[best].gain(scores[predicted])
        word = gain.word("not as predicted", same="no more than chance, so no contradiction")
        word = "as predicted" if best == predicted else word
        lines.append(
            f"{task}: the mean square error is least at N = {predicted}; reward in closed loop is "
            f"best at N = {best}, by {gain.reward:+.5f} a step (95 % "
            f"{signed_range(gain.reward_interval)}; it does not account for the choice of the best "
            f"on the same scenarios) compared with N = {predicted}: {word}"
        )
    return lines


def _plot(
    task: str, plans: Mapping[str, Mapping[str, Any]], scores: Mapping[int, EvalScores]
) -> Plot:
    def paint(figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        for k, (kind, row) in enumerate(plans.items()):
            at = [h["n"] for h in row["horizons"]]
            low, high = ([h[name] for h in row["horizons"]] for name in ("v_lb", "v_ub"))
            left.fill_between(at, low, high, color=f"C{k}", alpha=0.12, linewidth=0)
            found = [h["variance"] for h in row["horizons"]]
            left.plot(at, found, "o-", color=f"C{k}", label=kind)
            left.plot(at, [found[0] / n for n in at], ":", color=f"C{k}")
        left.set(xlabel="N", ylabel="variance of J_N's error")
        left.legend(fontsize=8)
        rewards = [each.reward_per_step for each in scores.values()]
        right.plot(list(scores), rewards, "o-", color="C2")
        ranges = np.array([each.reward_interval for each in scores.values()]).T
        right.fill_between(list(scores), *ranges, color="C2", alpha=0.15, linewidth=0)
        right.set(xlabel="N", ylabel="reward per step, closed loop")

    caption = (
        f"{task}: measured variance between its bounds (shaded), variance of independent "
        "errors (dotted), and reward against N"
    )
    return draw(f"bounds-{task}", caption, paint)
