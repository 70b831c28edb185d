"""Horizons, the autoregressive world model and other objectives (table I).

The paper's ordering is tested as claims that one row has more reward than another, on the same
scenarios.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from egovcp.artifact import read_options
from egovcp.errors import UsageError
from egovcp.eval_scores import EvalScores
from egovcp_experiment import results
from egovcp_experiment.cell import Flags
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.experiments.claims import WORDS, Claim, Verdict, count_verdicts, judge
from egovcp_experiment.gain_plot import Difference, gain_plot
from egovcp_experiment.grid import DEFAULT, REFERENCES, Grid, Model, parse_flags
from egovcp_experiment.report import (
    ExperimentReport,
    Plot,
    Table,
    listed,
    number,
    on_tasks,
    percent,
)

type RowScores = dict[str, dict[str, EvalScores]]
"""Task -> row -> scores."""


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    title: str
    model: str
    """A key of `MODELS`."""
    play: Flags
    """Flags of egovcp-eval."""
    paper: tuple[float, float, float] | None = None
    """The paper's mean rewards of wall, ball and arch; None: the paper has no such row."""
    longer: int = 1
    """How many times the gradient steps of the other rows; above 1 only with the first seed."""

    def trained(self, config: ExperimentConfig) -> Model:
        """The training of its model."""
        flags = MODELS[self.model]
        if self.longer == 1:
            return Model(self.model, flags)
        steps = self.longer * config.train.steps
        return Model(f"{self.model}_x{self.longer}", {**flags, "steps": steps}, seeds=1)

    def paper_reward(self, task: str) -> float | None:
        """The paper's mean reward on a task."""
        return None if self.paper is None else self.paper[("wall", "ball", "arch").index(task)]


_COLOURS: Final = dict(zip(WORDS, ("C2", "#98c898", "C3", "#e8a0a0", "0.5"), strict=True))
#: Model -> changed flags of egovcp-train.
MODELS: Final[dict[str, Flags]] = {
    DEFAULT: {},
    "arwm": {"policy.dynamics": "autoregressive"},
    "td": {"policy.loss.q_target": "td"},
    "mc": {"policy.loss.q_target": "mc"},
    "no_multistep": {"preset": "no_multistep"},
}
#: N -> the paper's rewards of wall, ball and arch.
_HORIZONS: Final[dict[int, tuple[float, float, float]]] = {
    1: (0.0557, -0.0066, -0.0396),
    2: (0.0607, 0.0056, 0.0154),
    3: (0.0611, 0.0059, 0.0156),
    4: (0.0614, 0.0061, 0.0157),
    5: (0.0598, 0.0058, 0.0144),
    6: (0.0617, 0.0053, 0.0115),
}
_TD_MPC: Final = (0.0699, -0.0016, 0.0145)


def _plan(objective: str, horizon: int = 4) -> Flags:
    return {"planner.objective": objective, "planner.horizon": horizon}


ROWS: Final[dict[str, Row]] = {
    **{
        f"ours_n{n}": Row(f"ours, N={n}", DEFAULT, _plan("value", n), paper)
        for n, paper in _HORIZONS.items()
    },
    "ours_mc": Row("ours, Q by returns", "mc", _plan("value"), _HORIZONS[4]),
    "no_multistep": Row("ours, no multi-step losses", "no_multistep", _plan("value")),
    "arwm": Row("ARWM", "arwm", _plan("value"), (0.0609, 0.0039, -0.0018)),
    "rew_mpc": Row("Rew-MPC", DEFAULT, _plan("reward"), (0.0302, -0.0033, -0.0211)),
    "td_mpc": Row("TD-MPC, Q as in ours", DEFAULT, _plan("td"), _TD_MPC),
    "td_mpc_td": Row("TD-MPC, Q by TD", "td", _plan("td"), _TD_MPC),
    "td_mpc_td_long": Row("TD-MPC, Q by TD, 3 x the steps", "td", _plan("td"), longer=3),
}
OURS: Final = "ours_n4"
#: The paper's ordering. It has one row of TD-MPC and does not give the target of its Q.
CLAIMS: Final = (
    Claim(OURS, "ours_n1", ("ball", "wall", "arch")),
    Claim(OURS, "arwm", ("ball", "arch")),
    Claim(OURS, "rew_mpc", ("ball", "wall", "arch")),
    Claim(OURS, "td_mpc", ("ball", "arch")),
    Claim("td_mpc", OURS, ("wall",)),
    Claim(OURS, "td_mpc_td", ("ball", "arch")),
    Claim("td_mpc_td", OURS, ("wall",)),
)
_LONG: Final = "td_mpc_td_long"
_FIRST: Final = (OURS, "arwm", "td_mpc_td")  # under --most
_ACHIEVED: Final = {
    "ball": "blocks {} of the balls",
    "wall": "braces in {} of the pushes",
    "arch": "passes {} of the arches",
}


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    """Request the cells of all rows; report those in ``records``.

    Raises:
        UsageError: the model of Rew-MPC and TD-MPC has no reward head.
    """
    config = grid.config
    names = [*_FIRST, *ROWS]
    if config.train.preset != DEFAULT:  # which that of the row would replace
        names.remove("no_multistep")
    chosen = config.chosen(dict.fromkeys(names))
    _require_reward_head(grid, chosen)
    plays = {
        task: {
            name: grid.plays(task, name, row.play, row.trained(config))
            for name, row in ROWS.items()
            if name in chosen
        }
        for task in config.tasks
    }
    references = {
        task: results.controller_scores(records, grid.references(task), task, REFERENCES)
        for task in config.tasks
    }
    scores = {
        task: found
        for task, cells in plays.items()
        if (found := results.all_scores(records, cells, task))
    }
    verdicts = [
        verdict
        for claim in CLAIMS
        for task in claim.tasks
        if (verdict := judge(claim, task, plays.get(task, {}), records)) is not None
    ]
    page = ExperimentReport(
        "Table I: horizons, autoregressive training and other objectives",
        _lead(verdicts, scores),
        _forest(verdicts, references),
        sections=[_introduction(config)],
        metrics={"claims": [v.metrics() for v in verdicts]},
    )
    if verdicts:
        page.findings.append(
            f"Were no two rows any different, about {0.025 * len(verdicts):.1f} of the "
            f"{len(verdicts)} claims would hold and as many be contradicted by chance."
        )
    page.findings += _longer_training(plays, records)
    if scores:
        page.sections.append(_summary(scores))
    if verdicts:
        head = (
            *("the paper's claim", "task", "here", "success (points)", "reward per step"),
            *("reward over trainings (95 %, t)", "trainings", "the paper's reward"),
        )
        title = "Differences, above - below, on the same scenarios"
        page.sections.append(Table(title, head, list(map(_claim_row, verdicts))))
    for task, rows in scores.items():
        titled = {ROWS[name].title: each for name, each in rows.items()}
        shown = {**titled, **references[task]}
        page.sections.append(results.comparison(task, shown, ROWS[OURS].title))
        page.sections += _terms(task, plays[task], records)
        page.metrics[task] = results.metrics_of({**rows, **references[task]})
    return page


def _longer_training(
    plays: Mapping[str, Mapping[str, Sequence[str]]], records: results.Records
) -> list[str]:
    """How the longer training of Q by TD compares with rows of equal steps, on one seed."""
    findings = []
    for other in ("td_mpc_td", OURS):
        words = {
            task: verdict.gain.word("better", "worse", "no different beyond chance")
            for task, cells in plays.items()
            if (verdict := judge(Claim(_LONG, other, (task,)), task, cells, records)) is not None
        }
        if words:
            findings.append(
                f"With the first training seed and by reward, {ROWS[_LONG].title}, is "
                f"{on_tasks(words)} than {ROWS[other].title}."
            )
    return findings


def _require_reward_head(grid: Grid, rows: Iterable[str]) -> None:
    path = grid.given_policy(grid.trained_on)
    given = bool(path) and read_options(Path(path))[0].loss.reward > 0
    weight = parse_flags(grid.config.train.flags).get("policy.loss.reward", "0")
    trained = weight not in ("0", "0.0")
    for name in rows:
        is_given = bool(path) and ROWS[name].model == DEFAULT
        if ROWS[name].play["planner.objective"] != "value" and not (given if is_given else trained):
            raise UsageError(
                f"--train.{'policies' if is_given else 'flags'}: row {name} plans with rewards and "
                "needs a model trained with --policy.loss.reward=1; give one, or leave such rows "
                "out with --only"
            )


def _introduction(config: ExperimentConfig) -> str:
    alone = " One training decides nothing about others." if len(config.train.seeds) == 1 else ""
    return (
        f"All models were trained for {config.train.steps} gradient steps on the data of all tasks "
        "and differ in the flags of their row only; ours, Rew-MPC and TD-MPC with Q as in ours "
        "plan with the same model. Q by TD is SARSA on the random walk of the data, without the "
        "critic that Q of ours is fitted to. Two rows are not the paper's, because ARWM differs "
        "from ours in more than the paper compares: `Q by returns` has the paper's own target, and "
        "`no multi-step losses` leaves out what the paper's model does not have. A longer training "
        f"of Q by TD has one seed.{alone}"
    )


def _lead(verdicts: Sequence[Verdict], scores: RowScores) -> list[str]:
    lines = []
    ours = [
        _ACHIEVED[task].format(percent(rows[OURS].success_rate))
        for task, rows in scores.items()
        if OURS in rows
    ]
    if ours:
        lines.append(f"Ours (N = 4) {listed(ours)}.")
    if verdicts:
        lines.append(f"Of the paper's {len(verdicts)} claims {count_verdicts(verdicts)}.")
    best = [text for task, rows in scores.items() if (text := _best_horizon(task, rows))]
    if best:
        lines.append(f"Of the horizons the most reward is earned by {listed(best)}.")
    return lines


def _best_horizon(task: str, rows: Mapping[str, EvalScores]) -> str:
    """The best horizon on a task; empty without N = 4 and another one."""
    ours = {n: rows[f"ours_n{n}"] for n in _HORIZONS if f"ours_n{n}" in rows}
    if len(ours) < 2 or OURS not in rows:
        return ""
    best = max(ours, key=lambda n: ours[n].reward_per_step)
    beyond = best == 4 or ours[best].gain(rows[OURS]).reward_interval[0] > 0
    return f"N = {best} ({task}{'' if beyond else ', by no more than chance'})"


def _title(claim: Claim) -> str:
    return f"{ROWS[claim.above].title} above {ROWS[claim.below].title}"


def _claim_row(verdict: Verdict) -> tuple[str, ...]:
    """In the table of claims."""
    above, below = (
        ROWS[name].paper_reward(verdict.task) for name in (verdict.claim.above, verdict.claim.below)
    )
    paper = None if above is None or below is None else above - below
    spread = verdict.over_trainings
    return (
        *(_title(verdict.claim), verdict.task, verdict.word, *verdict.gain.columns()),
        "-" if spread is None else f"{spread[0]:+.5f} ± {spread[1]:.5f}",
        f"{verdict.agreeing} of {len(verdict.differences)}",
        number(paper, "+.4f"),
    )


def _forest(
    verdicts: Sequence[Verdict], references: Mapping[str, Mapping[str, EvalScores]]
) -> Plot | None:
    """The differences of all claims whose task has references."""
    scale = {
        task: 100 / (found["oracle"].reward_per_step - found["hold"].reward_per_step)
        for task, found in references.items()
        if {"oracle", "hold"} <= found.keys()
        and found["oracle"].reward_per_step != found["hold"].reward_per_step
    }
    shown: dict[str, Difference] = {}
    for v in verdicts:
        if v.task in scale:
            low, high = (scale[v.task] * end for end in v.gain.reward_interval)
            difference = Difference(scale[v.task] * v.gain.reward, (low, high), _COLOURS[v.word])
            shown[f"{_title(v.claim)}: {v.task}"] = difference
    if not shown:
        return None
    caption = (
        "The paper's claims: holds (green), contradicted (red), undecided (grey); light: on "
        "average only"
    )
    label = "difference in reward, % of that between oracle and hold"
    return gain_plot("claims", caption, {"": shown}, label)


def _summary(scores: RowScores) -> Table:
    """The table as in the paper."""
    best = {t: max(each.reward_per_step for each in rows.values()) for t, rows in scores.items()}
    lines = []
    for name in (name for name in ROWS if any(name in rows for rows in scores.values())):
        line = [ROWS[name].title]
        for task, rows in scores.items():
            paper = number(ROWS[name].paper_reward(task), "+.4f")
            if name not in rows:
                line += ["-", "-", "-", paper]
                continue
            each = rows[name]
            reward = f"{each.reward_per_step:+.4f}"
            reward = f"**{reward}**" if each.reward_per_step == best[task] else reward
            spread = "" if each.reward_spread is None else f" ± {each.reward_spread:.4f}"
            trials = number(each.reward_trial_spread, ".4f")
            line += [f"{reward}{spread}", trials, percent(each.success_rate), paper]
        lines.append(line)
    columns = ("reward/step", "sd of trials", "success", "the paper's reward")
    heads = [f"{task}: {columns[0]}" if c == columns[0] else c for task in scores for c in columns]
    title = (
        "Reward per step, ± its standard deviation over trainings where there are several; a trial "
        "is a tenth of the scenarios with one training"
    )
    return Table(title, ("", *heads), lines)


def _terms(task: str, rows: Mapping[str, Sequence[str]], records: results.Records) -> list[Table]:
    """What the reward of each row consists of, if the evaluations recorded it."""
    shares: dict[str, dict[str, float]] = {}
    for name, cells in rows.items():
        every = (records[c]["metrics"][task]["planner"]["played"] for c in cells if c in records)
        found = [played for played in every if "terms" in played]
        steps = sum(sum(played["steps"]) for played in found)
        for term in found[0]["terms"] if found else ():
            total = sum(sum(played["terms"][term]) for played in found)
            shares.setdefault(ROWS[name].title, {})[term] = total / steps
    terms = list(dict.fromkeys(term for row in shares.values() for term in row))
    lines = [
        (title, *(number(row.get(term), "+.5f") for term in terms)) for title, row in shares.items()
    ]
    return [Table(f"{task}: reward per step by term", ("", *terms), lines)] if lines else []
