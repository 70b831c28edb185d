"""Horizons, the autoregressive world model and other objectives (table I).

The paper's ordering is tested as claims that one row has more reward than another, on the same
scenarios.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from egovcp.eval_scores import EvalScores, Gain
from egovcp_experiment import results
from egovcp_experiment.cell import Flags
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.grid import REFERENCES, Grid, Model
from egovcp_experiment.report import ExperimentReport, Table, number, percent

type Scores = dict[str, dict[str, EvalScores]]
"""Task -> row -> scores."""


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    title: str
    model: str
    """A key of `MODELS`."""
    play: Flags
    """Flags of egovcp-eval."""
    paper: tuple[float, float, float]
    """The paper's mean rewards of wall, ball and arch."""


@dataclass(frozen=True)
class Claim:
    """Row ``above`` has more reward than row ``below``."""

    above: str
    below: str
    tasks: tuple[str, ...]
    """Tasks for which it is claimed."""

    @property
    def title(self) -> str:
        """In words."""
        return f"{ROWS[self.above].title} above {ROWS[self.below].title}"


@dataclass(frozen=True)
class Verdict:
    """Results for a claim on one task."""

    claim: Claim
    task: str
    gain: Gain
    """``above`` minus ``below``."""
    agreeing: int
    """Trainings in which ``above`` has more reward."""
    seeds: int
    """Trainings of both."""

    @property
    def word(self) -> str:
        """One of `WORDS`, by the interval of the reward."""
        holds = WORDS[0] if self.agreeing == self.seeds else WORDS[1]
        return self.gain.word(holds, *WORDS[2:])

    @property
    def text(self) -> str:
        """The word with its figures."""
        trainings = "" if self.seeds == 1 else f", in {self.agreeing} of {self.seeds} trainings"
        return f"{self.task} {self.word} ({self.gain}{trainings})"

    def figures(self) -> dict[str, Any]:
        """For programs."""
        return {
            "above": self.claim.above,
            "below": self.claim.below,
            "task": self.task,
            "verdict": self.word,
            "reward_gain": self.gain.reward,
            "reward_gain_ci95": list(self.gain.reward_interval),
            "success_gain": self.gain.success,
            "success_gain_ci95": list(self.gain.success_interval),
            "seeds_in_favour": self.agreeing,
            "seeds": self.seeds,
        }

    def row(self) -> tuple[str, ...]:
        """In the table of claims."""
        k = ("wall", "ball", "arch").index(self.task)
        paper = ROWS[self.claim.above].paper[k] - ROWS[self.claim.below].paper[k]
        trainings = f"{self.agreeing} of {self.seeds}"
        columns = (*self.gain.columns(), trainings, f"{paper:+.4f}")
        return (self.claim.title, self.task, self.word, *columns)


WORDS: Final = ("holds", "holds on average only", "contradicted", "undecided")
#: Model -> flags of egovcp-train. All have a reward head, so that nothing else differs.
MODELS: Final[dict[str, Flags]] = {
    "reward": {"policy.loss.reward": 1},
    "reward_arwm": {"policy.loss.reward": 1, "policy.dynamics": "autoregressive"},
    "reward_td": {"policy.loss.reward": 1, "policy.loss.q_target": "td"},
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
        f"ours_n{n}": Row(f"ours, N={n}", "reward", _plan("value", n), paper)
        for n, paper in _HORIZONS.items()
    },
    "arwm": Row("ARWM", "reward_arwm", _plan("value"), (0.0609, 0.0039, -0.0018)),
    "rew_mpc": Row("Rew-MPC", "reward", _plan("reward"), (0.0302, -0.0033, -0.0211)),
    "td_mpc": Row("TD-MPC, Q as in ours", "reward", _plan("td"), _TD_MPC),
    "td_mpc_td": Row("TD-MPC, Q by TD", "reward_td", _plan("td"), _TD_MPC),
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
_FIRST: Final = (OURS, "arwm", "td_mpc_td")  # under --most: one row of each model


def report(grid: Grid, records: results.Records) -> ExperimentReport:
    config = grid.config
    chosen = config.chosen(dict.fromkeys([*_FIRST, *ROWS]))
    plays = {
        task: {
            name: grid.plays(task, name, row.play, Model(row.model, MODELS[row.model]))
            for name, row in ROWS.items()
            if name in chosen
        }
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
        _conclusions(verdicts, scores),
        [_introduction(config)],
        {"claims": [v.figures() for v in verdicts]},
    )
    if scores:
        page.sections.append(_summary(scores))
    if verdicts:
        head = (
            *("the paper's claim", "task", "here", "success (points)", "95 %", "reward/step"),
            *("95 %", "trainings", "the paper's reward"),
        )
        title = "Differences, above - below, on the same scenarios"
        page.sections.append(Table(title, head, [verdict.row() for verdict in verdicts]))
    for task in config.tasks:
        cell = grid.references(task)
        if task in scores:
            references = results.controller_scores(records, cell, task, REFERENCES)
            titled = {ROWS[name].title: each for name, each in scores[task].items()}
            ours = ROWS[OURS].title
            page.sections.append(results.comparison(task, {**titled, **references}, ours))
            page.sections.append(results.comparison_plot(task, task, titled, ours))
            page.figures[task] = results.figures_of({**scores[task], **references})
    return page


def judge(
    claim: Claim, task: str, rows: Mapping[str, Sequence[str]], records: results.Records
) -> Verdict | None:
    """The verdict from the trainings that both rows have; None without any.

    ``rows``: row -> names of its cells, one per training seed.
    """
    pairs = zip(rows.get(claim.above, ()), rows.get(claim.below, ()), strict=False)
    both = [(above, below) for above, below in pairs if above in records and below in records]
    ours = results.eval_scores(records, [above for above, _ in both], task)
    theirs = results.eval_scores(records, [below for _, below in both], task)
    if ours is None or theirs is None:
        return None
    return Verdict(
        claim,
        task,
        ours.gain(theirs),
        agreeing=int((ours.reward_of_seeds > theirs.reward_of_seeds).sum()),
        seeds=len(both),
    )


def _introduction(config: ExperimentConfig) -> str:
    seeds = len(config.train.seeds)
    chance = (
        "Intervals are over scenarios, for one training of each model: they do not include the "
        "variation between training seeds."
        if seeds == 1
        else f"Intervals are over scenarios, for these {seeds} trainings of each model; the number "
        "of trainings in which a claim holds is given, too."
    )
    return (
        f"All models were trained for {config.train.steps} gradient steps on the data of all tasks "
        "with a head for rewards (`--policy.loss.reward=1`), and differ in the flags of their row "
        "only. Ours, Rew-MPC and TD-MPC with Q as in ours plan with the same model. All rows play "
        f"the same scenarios. {chance}"
    )


def count_verdicts(verdicts: Sequence[Verdict]) -> str:
    """Number of verdicts of each kind, and how many to expect by chance."""
    count = len(verdicts)
    words = [verdict.word for verdict in verdicts]
    kinds = ", ".join(f"{words.count(w)} {w}" for w in WORDS if w in words)
    return (
        f"of {count} claims, one for each task: {kinds} (95 % intervals; were no two rows any "
        f"different, about {0.025 * count:.1f} would hold and as many be contradicted by chance)"
    )


def _conclusions(verdicts: Sequence[Verdict], scores: Scores) -> list[str]:
    lines = [count_verdicts(verdicts)] if verdicts else []
    for claim in CLAIMS:
        own = [verdict.text for verdict in verdicts if verdict.claim == claim]
        if own:
            lines.append(f"{claim.title}: {'; '.join(own)}")
    return lines + [_best_horizon(task, rows) for task, rows in scores.items() if OURS in rows]


def _best_horizon(task: str, rows: Mapping[str, EvalScores]) -> str:
    ours = {n: rows[f"ours_n{n}"] for n in _HORIZONS if f"ours_n{n}" in rows}
    text = f"{task}: {percent(rows[OURS].success_rate)} success at N=4"
    if len(ours) < 2:
        return text
    best = max(ours, key=lambda n: ours[n].reward_per_step)
    text += f"; of N={', '.join(map(str, ours))} the most reward at N={best}"
    if ours[best] is rows[OURS]:
        return text
    gain = ours[best].gain(rows[OURS])
    word = gain.word("beyond", same="not beyond")
    return (
        f"{text}, {word} chance ({gain}, compared with N=4; chosen on the same scenarios, which "
        "the interval does not account for)"
    )


def _summary(scores: Scores) -> Table:
    """The table as in the paper."""
    best = {t: max(each.reward_per_step for each in rows.values()) for t, rows in scores.items()}
    lines = []
    for name in (name for name in ROWS if any(name in rows for rows in scores.values())):
        line = [ROWS[name].title]
        for task, rows in scores.items():
            if name not in rows:
                line += ["-", "-", "-"]
                continue
            each = rows[name]
            reward = f"{each.reward_per_step:+.4f}"
            reward = f"**{reward}**" if each.reward_per_step == best[task] else reward
            spread = "" if each.reward_spread is None else f" ± {each.reward_spread:.4f}"
            trials = number(each.reward_trial_spread, ".4f")
            line += [f"{reward}{spread}", trials, percent(each.success_rate)]
        lines.append(line)
    heads = [h for task in scores for h in (f"{task}: reward/step", "sd of trials", "success")]
    title = (
        "Reward per step, ± its standard deviation over trainings where there are several; a trial "
        "is a tenth of the scenarios with one training"
    )
    return Table(title, ("", *heads), lines)
