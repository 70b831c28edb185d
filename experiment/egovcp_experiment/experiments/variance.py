"""Whether errors of Q along a plan average out and predict the best horizon (section III-D)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from egovcp.eval_scores import EvalScores
from egovcp.spec import ACTION_ETA, HELD_ETA, HELD_TICKS
from egovcp_experiment import results
from egovcp_experiment.experiments.table1 import MODELS, ROWS
from egovcp_experiment.grid import Grid, Model, parse_flags
from egovcp_experiment.report import ExperimentReport, Plot, Table, draw, percent
from egovcp_experiment.studies.residuals import STEPS

_HORIZONS: Final = tuple(range(1, STEPS + 1))
#: The model whose Q was trained on returns, with the cells of its row in `table1`.
_RETURNS: Final = Model("mc", MODELS["mc"])
_RETURNS_ROWS: Final = {
    1: ("ours_mc_n1", {**ROWS["ours_mc"].play, "planner.horizon": 1}),
    4: ("ours_mc", ROWS["ours_mc"].play),
}


def _walk(eta: float, least: int, most: int) -> dict[str, str]:
    """Flags of a random walk of egovcp-collect."""
    return {"eta": str(eta), "step_ticks": f"[{least},{most}]", "boundary": "reflect"}


#: The random walk of `egovcp-collect` by default and of its preset `paper`, as flags.
_COLLECT_WALK: Final = _walk(HELD_ETA, *HELD_TICKS)
_PAPER_WALK: Final = _walk(ACTION_ETA, 1, 1)
_PLANS: Final = {"planner": "plans that the planner chose", "random": "random plans"}

type Plans = Mapping[str, Any]
"""Kind of plans -> its analysis in the study `residuals`."""
type HorizonScores = Mapping[int, EvalScores]
"""Horizon -> scores in closed loop."""


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    given = parse_flags(config.data.flags)
    walk = _PAPER_WALK if given.get("preset") == "paper" else _COLLECT_WALK
    walk = walk | {name: given[name] for name in _COLLECT_WALK if name in given}
    page = ExperimentReport(
        "Variance: do the errors of Q along a plan average out?",
        sections=[
            "Errors are Q along an imagined plan minus the mean return of random walks that the "
            "simulator takes from the same step of the same plan; the variance of that mean is "
            "taken off. The model is `mc`, whose Q was trained on such returns "
            "(`--policy.loss.q_target=mc`): by default Q is trained on the privileged value of "
            "planned actions, from which returns of random walks differ without an error. Bounds "
            "use the largest correlation between two steps and the least and largest variance, as "
            "in the paper. `cutting`: returns as in training minus returns to the end of the "
            "episode."
        ],
    )
    residuals: dict[str, Plans] = {}
    own: dict[str, HorizonScores] = {}
    default: dict[str, HorizonScores] = {}
    for task in config.tasks:
        flags = {"task": task, "episodes": config.play.episodes, "branches": config.play.branches}
        cell = grid.sim_study("residuals", task, {**flags, **walk}, _RETURNS)
        if cell in records:
            page.metrics[task] = {"residuals": records[cell]["metrics"]["plans"]}
            plans = {k: row for k, row in page.metrics[task]["residuals"].items() if "rho" in row}
            if plans:
                residuals[task] = plans
            page.sections += [_table(task, kind, row) for kind, row in plans.items()]
        rows = {n: (f"ours_n{n}", ROWS[f"ours_n{n}"].play) for n in _HORIZONS}
        plays = {n: grid.plays(task, *row) for n, row in rows.items()}
        returns = {n: grid.plays(task, *row, _RETURNS) for n, row in _RETURNS_ROWS.items()}
        for found, cells in ((default, plays), (own, returns)):
            if scores := results.all_scores(records, cells, task):
                found[task] = scores
        shown = {f"N = {n}": each for n, each in default.get(task, {}).items()}
        shown |= {f"mc, N = {n}": each for n, each in own.get(task, {}).items()}
        if shown:
            page.sections.append(results.comparison(f"{task}: closed loop", shown, "N = 4"))
            page.metrics.setdefault(task, {})["horizons"] = results.metrics_of(shown)
        _add_terms(grid, records, page, task, plays)
    page.lead = _lead(residuals, own, default)
    if residuals or default:
        page.plot = _plot(list(config.tasks), residuals, own, default)
    return page


def _lead(
    residuals: Mapping[str, Plans],
    own: Mapping[str, HorizonScores],
    default: Mapping[str, HorizonScores],
) -> list[str]:
    rows = {task: plans.get("planner") or plans["random"] for task, plans in residuals.items()}
    lines = []
    if rows:
        each = "; ".join(
            f"{task}: correlation {_correlation(row)}, {_share(row)}" for task, row in rows.items()
        )
        lines.append(
            "Errors of neighbouring steps, and the share of their variance at N = 1 that averaging "
            f"over N = 4 leaves (25 % if they were independent), are: {each}."
        )
    verdicts = []
    for task, row in rows.items():
        scores = own.get(task, {})
        if len(scores) == len(_RETURNS_ROWS):
            predicted, other = sorted((4, 1), key=lambda n: row["horizons"][n - 1]["error"])
            word = scores[predicted].gain(scores[other]).word("confirmed", "contradicted")
            verdicts.append(f"{task} N = {predicted}, {word}")
    if verdicts:
        lines.append(
            "The mean square error of J predicts which of N = 1 and 4 earns more reward in closed "
            f"loop with this model: {'; '.join(verdicts)}."
        )
    whole = {task: scores for task, scores in default.items() if len(scores) == len(_HORIZONS)}
    if whole:
        best = ", ".join(_best(task, scores) for task, scores in whole.items())
        lines.append(f"The default model earns the most reward at {best}.")
    return lines


def _best(task: str, scores: HorizonScores) -> str:
    best = max(scores, key=lambda n: scores[n].reward_per_step)
    if best == 4:
        return f"N = 4 ({task})"
    word = scores[best].gain(scores[4]).word("more than", same="not beyond chance above")
    return f"N = {best} ({task}, {word} N = 4)"


def _correlation(row: Mapping[str, Any]) -> str:
    low, high = row["rho_next_ci95"]
    return f"{row['rho_next']:.2f} ({low:.2f} to {high:.2f})"


def _share(row: Mapping[str, Any]) -> str:
    """A dash if the variance of N = 1 may be zero."""
    if row["share_4"] is None:
        return "-"
    low, high = row["share_4_ci95"]
    return f"{100 * row['share_4']:.0f} % ({100 * low:.0f} to {100 * high:.0f} %)"


def _add_terms(
    grid: Grid,
    records: results.Records,
    page: ExperimentReport,
    task: str,
    plays: Mapping[int, list[str]],
) -> None:
    """The mean of Q over a plan next to its first and its last term alone, and to one step."""
    kept = ("task", "episodes", "seed")
    flags = {
        name: value
        for name, value in grid.scenarios(task).items()
        if name in kept or name.startswith("env.")
    }
    cell = grid.study("plan_terms", task, flags)
    if cell not in records:
        return
    found = records[cell]["metrics"]
    terms = {
        f"{term} term": EvalScores(
            np.array([row["reward"]]), np.array([row["steps"]]), np.array([row["success"]], float)
        )
        for term, row in found["terms"].items()
    }
    n = found["horizon"]
    first = {k: plays[k][:1] for k in (n, 1) if k in plays}  # of the same training
    names = {n: "planner", 1: "one step"}
    played = results.all_scores(records, first, task)
    scores = {names[k]: each for k, each in played.items()} | terms
    title = (
        f"{task}: plans of N = {n}, chosen by the mean of Q (planner) or by one term of it, and "
        "plans of one step"
    )
    page.sections.append(results.comparison(title, scores, "planner"))
    spread = ", ".join(f"{value / found['return_std']:.2f}" for value in found["spread"])
    page.findings.append(
        f"{task}: the terms of random plans have standard deviations of {spread} of that of the "
        "return"
    )
    words = [
        f"{name} {scores[name].gain(scores['planner']).word()} ({percent(each.success_rate)})"
        for name, each in scores.items()
        if "planner" in scores and name != "planner"
    ]
    if words:
        page.findings.append(
            f"{task}: compared with the planner ({percent(scores['planner'].success_rate)}), by "
            f"reward: {', '.join(words)}"
        )
    page.metrics.setdefault(task, {})["terms"] = {
        **results.metrics_of(scores),
        "spread": found["spread"],
    }


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
    title = (
        f"{task}, {_PLANS[kind]} ({row['plans']}; correlation of neighbouring steps "
        f"{_correlation(row)}, largest {row['rho_max']:.2f}; variance that N = 4 leaves of N = 1: "
        f"{_share(row)})"
    )
    return Table(title, head, rows)


def _plot(
    tasks: list[str],
    residuals: Mapping[str, Plans],
    own: Mapping[str, HorizonScores],
    default: Mapping[str, HorizonScores],
) -> Plot:
    def paint(figure: Any) -> None:
        rows = figure.subplots(len(tasks), 2, squeeze=False, sharex=True)
        for task, (left, right) in zip(tasks, rows, strict=True):
            for k, (kind, row) in enumerate(residuals.get(task, {}).items()):
                at = [h["n"] for h in row["horizons"]]
                low, high = ([h[name] for h in row["horizons"]] for name in ("v_lb", "v_ub"))
                left.fill_between(at, low, high, color=f"C{k}", alpha=0.12, linewidth=0)
                found = [h["variance"] for h in row["horizons"]]
                left.plot(at, found, "o-", color=f"C{k}", label=_PLANS[kind])
                left.plot(at, [found[0] / n for n in at], ":", color=f"C{k}")
            for colour, label, scores in (
                ("C2", "default model", default.get(task)),
                ("C3", "mc", own.get(task)),
            ):
                if scores:
                    means = [each.reward_per_step for each in scores.values()]
                    ranges = np.array([each.reward_interval for each in scores.values()]).T
                    right.plot(list(scores), means, "o-", color=colour, label=label)
                    right.fill_between(list(scores), *ranges, color=colour, alpha=0.15, linewidth=0)
            left.set_ylabel(f"{task}: variance")
            right.set_ylabel("reward per step")
        for axes in rows[-1]:
            axes.set_xlabel("N")
        for axes in rows[0]:
            if axes.has_data():
                axes.legend(fontsize=8)

    caption = (
        "Left: variance of J_N's error between its bounds (shaded), and that of independent errors "
        "(dotted), model mc; right: reward in closed loop"
    )
    return draw("horizons", caption, paint, (8.0, 0.6 + 2.2 * len(tasks)))
