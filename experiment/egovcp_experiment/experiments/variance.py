"""Does averaging Q along a plan help because its errors average out (section III-D)?"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from egovcp_experiment.cell import Cell
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.experiment import Experiment
from egovcp_experiment.grid import Grid, Variant
from egovcp_experiment.outcomes import Outcome, outcome
from egovcp_experiment.report.comparison import comparison
from egovcp_experiment.report.document import Plot, Report, Table
from egovcp_experiment.report.svg import drawn
from egovcp_experiment.store import Record
from egovcp_experiment.studies.residuals import STEPS
from egovcp_experiment.tools import study

_HORIZONS: Final = tuple(range(1, STEPS + 1))
_WALK: Final = ("--eta", "--step_ticks", "--boundary")  # flags of egovcp-collect
_PLANS: Final = {"planner": "plans that the planner chose", "random": "random plans"}


def _residuals(config: ExperimentConfig, grid: Grid, task: str) -> str:
    flags = {
        **grid.planner(task),
        "policy.path": grid.model(task, config.train.seeds[0]),
        "task": task,
        "episodes": config.play.episodes,
        "branches": config.play.branches,
        "seed": config.play.seed,
    }
    walk = tuple(flag for flag in config.data.flags if flag.partition("=")[0] in _WALK)
    more = (*config.scenes, *walk)
    return grid.add(Cell(f"residuals-{task}", study("residuals"), flags, more)).name


def _plays(config: ExperimentConfig, grid: Grid, task: str) -> dict[int, list[str]]:
    """Horizon -> names of its cells, one for each seed."""
    return {
        n: [
            grid.play(task, s, Variant(f"horizon_{n}", play={"planner.horizon": n})).name
            for s in config.train.seeds
        ]
        for n in _HORIZONS
    }


def _cells(config: ExperimentConfig) -> list[Cell]:
    grid = Grid(config)
    for task in config.tasks:
        _residuals(config, grid, task)
        _plays(config, grid, task)
    return grid.cells


def _report(config: ExperimentConfig, records: Mapping[str, Record]) -> Report:
    grid = Grid(config)
    shows: list[str] = []
    parts: list[str | Table | Plot] = [
        "Residuals are Q along an imagined plan minus the mean return of random walks that the "
        "simulator takes from the same step of the same plan; the variance of that mean is taken "
        "off. Bounds use the largest correlation between two steps and the least and largest "
        "variance, as in the paper. `cutting`: returns as in training minus returns to the end of "
        "the episode."
    ]
    figures: dict[str, Any] = {}
    for task in config.tasks:
        played = {
            n: o
            for n, cells in _plays(config, grid, task).items()
            if (o := outcome(records, cells, task)) is not None
        }
        figures[task] = {"horizons": {str(n): o.figures() for n, o in played.items()}}
        name = _residuals(config, grid, task)
        if name in records:
            plans = records[name]["figures"]["plans"]
            figures[task]["residuals"] = plans
            known = {kind: row for kind, row in plans.items() if "horizons" in row}
            parts += [_table(task, kind, row) for kind, row in known.items()]
            if known and played:
                parts.append(_plot(task, known, played))
            shows += _shows(task, known, played)
        if played:
            rows = {f"N = {n}": o for n, o in played.items()}
            parts.append(comparison(f"{task}: closed loop", rows, "N = 4"))
    title = "Variance: do the errors of Q along a plan average out?"
    return Report(title, tuple(shows), tuple(parts), figures)


def _table(task: str, kind: str, row: Mapping[str, Any]) -> Table:
    rows = tuple(
        (
            str(at["n"]),
            f"{row['sigma'][at['n'] - 1]:.4f}",
            f"{row['bias'][at['n'] - 1]:+.4f}",
            f"{row['bias_of_cutting'][at['n'] - 1]:+.4f}",
            f"{at['variance']:.5f}",
            f"{at['v_lb']:.5f}",
            f"{at['v_ub']:.5f}",
            f"{at['bias']:+.4f}",
            f"{at['error']:.5f}",
        )
        for at in row["horizons"]
    )
    head = (
        *("N", "sigma of step N-1", "its bias", "cutting", "Var of J_N's error"),
        *("V_lb", "V_ub", "bias of J_N", "mean square"),
    )
    title = f"{task}, {_PLANS[kind]} ({row['plans']}; largest correlation {row['rho_max']:.2f})"
    return Table(title, head, rows)


def _shows(
    task: str, plans: Mapping[str, Mapping[str, Any]], played: Mapping[int, Outcome]
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
    if plans and len(played) == len(_HORIZONS):
        row = plans.get("planner") or next(iter(plans.values()))
        predicted = min(row["horizons"], key=lambda at: at["error"])["n"]
        best = max(played, key=lambda n: played[n].reward_per_step)
        gain, (low, high) = played[best].reward_gain(played[predicted])
        lines.append(
            f"{task}: the mean square error is least at N = {predicted}; reward in closed loop is "
            f"best at N = {best}, by {gain:+.5f} a step (95 % {low:+.5f} to {high:+.5f}) beside "
            f"N = {predicted}: " + _verdict(best == predicted, low)
        )
    return lines


def _verdict(same: bool, low: float) -> str:
    if same:
        return "as predicted"
    return "not as predicted" if low > 0 else "no more than chance, so no contradiction"


def _plot(task: str, plans: Mapping[str, Mapping[str, Any]], played: Mapping[int, Outcome]) -> Plot:
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
        right.plot(list(played), [o.reward_per_step for o in played.values()], "o-", color="C2")
        ranges = [o.reward_interval for o in played.values()]
        right.fill_between(
            list(played),
            [r[0] for r in ranges],
            [r[1] for r in ranges],
            color="C2",
            alpha=0.15,
            linewidth=0,
        )
        right.set(xlabel="N", ylabel="reward per step, closed loop")

    caption = (
        f"{task}: measured variance between its bounds (shaded) and beside that of independent "
        "errors (dotted), and reward against N"
    )
    return drawn(f"bounds-{task}", caption, paint)


EXPERIMENT: Final = Experiment(
    "do the errors of Q along a plan average out, and predict the best horizon (section III-D)?",
    _cells,
    _report,
)
