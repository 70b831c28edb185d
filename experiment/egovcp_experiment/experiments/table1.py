"""Horizons, the autoregressive world model and other objectives beside ours (table I)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from egovcp_experiment.cell import Cell, Flags
from egovcp_experiment.claims import Claim, Verdict, by_chance, weigh
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.experiment import Experiment
from egovcp_experiment.grid import BOUNDS, Grid, Model, Variant
from egovcp_experiment.outcomes import Outcome, outcome, side_by_side
from egovcp_experiment.report.comparison import comparison, gain_plot
from egovcp_experiment.report.document import (
    Plot,
    Report,
    Table,
    number,
    percent,
    points_range,
)
from egovcp_experiment.report.heldout import Models, add, models_table
from egovcp_experiment.store import Record

type Cells = dict[str, dict[str, dict[int, str]]]  # task -> row -> seed -> name of the cell
type Played = dict[str, dict[str, Outcome]]  # task -> row -> what was played


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


#: What is trained. All have a head for rewards, so that they differ in nothing else.
MODELS: Final[dict[str, Flags]] = {
    "reward": {"policy.loss.reward": 1},
    "reward_arwm": {"policy.loss.reward": 1, "policy.dynamics": "autoregressive"},
    "reward_td": {"policy.loss.reward": 1, "policy.loss.q_target": "td"},
}
#: What the model is called where models are compared, not rows.
_CALLED: Final = {"reward": "joint embedding", "reward_arwm": "ARWM", "reward_td": "Q by TD"}
#: N -> the paper's rewards of wall, ball and arch.
_HORIZONS: Final[dict[int, tuple[float, float, float]]] = {
    1: (0.0557, -0.0066, -0.0396),
    2: (0.0607, 0.0056, 0.0154),
    3: (0.0611, 0.0059, 0.0156),
    4: (0.0614, 0.0061, 0.0157),
    5: (0.0598, 0.0058, 0.0144),
    6: (0.0617, 0.0053, 0.0115),
}
_ARWM: Final = (0.0609, 0.0039, -0.0018)
_REW_MPC: Final = (0.0302, -0.0033, -0.0211)
_TD_MPC: Final = (0.0699, -0.0016, 0.0145)


def _plan(objective: str, horizon: int = 4) -> Flags:
    return {"planner.objective": objective, "planner.horizon": horizon}


def _horizon(n: int) -> str:
    return f"ours_n{n}"


ROWS: Final[dict[str, Row]] = {
    **{
        _horizon(n): Row(f"ours, N={n}", "reward", _plan("value", n), paper)
        for n, paper in _HORIZONS.items()
    },
    "arwm": Row("ARWM", "reward_arwm", _plan("value"), _ARWM),
    "rew_mpc": Row("Rew-MPC", "reward", _plan("reward"), _REW_MPC),
    "td_mpc_mc": Row("TD-MPC, Q by MC", "reward", _plan("td"), _TD_MPC),
    "td_mpc_td": Row("TD-MPC, Q by TD", "reward_td", _plan("td"), _TD_MPC),
}
OURS: Final = _horizon(4)
#: The paper's ordering. It has one row of TD-MPC and does not say what its Q is trained on.
CLAIMS: Final = (
    Claim(OURS, _horizon(1), ("ball", "wall", "arch")),
    Claim(OURS, "arwm", ("ball", "arch")),
    Claim(OURS, "rew_mpc", ("ball", "wall", "arch")),
    Claim(OURS, "td_mpc_mc", ("ball", "arch")),
    Claim("td_mpc_mc", OURS, ("wall",)),
    Claim(OURS, "td_mpc_td", ("ball", "arch")),
    Claim("td_mpc_td", OURS, ("wall",)),
)
_FIRST: Final = (OURS, "arwm", "td_mpc_td")  # under --most: one row of each model comes first


def _names(config: ExperimentConfig) -> list[str]:
    """The rows that are asked for, in the order of the table."""
    chosen = config.chosen(dict.fromkeys([*_FIRST, *ROWS]))
    return [name for name in ROWS if name in chosen]


def _model(config: ExperimentConfig, name: str) -> Model:
    """Of equal steps, without a limit of time, in which slower models would learn less."""
    equal = {"steps": config.train.compared_steps, "max_minutes": 0}
    return Model(name, {**equal, **MODELS[name]})


def _plays(config: ExperimentConfig, grid: Grid) -> Cells:
    found: Cells = {}
    for task in config.tasks:
        for name in _names(config):
            row = ROWS[name]
            variant = Variant(name, _model(config, row.model), row.play)
            cells = {seed: grid.play(task, seed, variant).name for seed in config.train.seeds}
            found.setdefault(task, {})[name] = cells
    return found


def _cells(config: ExperimentConfig) -> list[Cell]:
    grid = Grid(config)
    _plays(config, grid)
    for task in config.tasks:
        grid.bounds(task)
    return grid.cells


def _report(config: ExperimentConfig, records: Mapping[str, Record]) -> Report:
    grid = Grid(config)
    cells = _plays(config, grid)
    found = _played(cells, records)
    models = _models(config, grid, records)
    verdicts = _verdicts(cells, records)
    parts: list[str | Table | Plot] = [_training(config)]
    parts += [_summary(found)] if found else []
    parts += [_claims(verdicts)] if verdicts else []
    parts += [models_table(models)] if models else []
    figures: dict[str, Any] = {
        "claims": [verdict.figures() for verdict in verdicts],
        "models": models,
    }
    for task, rows in found.items():
        others = side_by_side(records, f"bounds-{task}", task, BOUNDS)
        named = {ROWS[name].title: played for name, played in rows.items()}
        ours = ROWS[OURS].title
        parts.append(comparison(task, {**named, **others}, ours))
        parts.append(gain_plot(task, task, named, ours))
        figures[task] = {name: played.figures() for name, played in {**rows, **others}.items()}
    title = "Table I: horizons, autoregressive training and other objectives beside ours"
    return Report(title, tuple(_shows(verdicts, found)), tuple(parts), figures)


def _played(cells: Cells, records: Mapping[str, Record]) -> Played:
    found: Played = {}
    for task, rows in cells.items():
        for name, seeds in rows.items():
            played = outcome(records, seeds.values(), task)
            if played is not None:
                found.setdefault(task, {})[name] = played
    return found


def _models(config: ExperimentConfig, grid: Grid, records: Mapping[str, Record]) -> Models:
    found: Models = {}
    for task in config.tasks:
        for name in dict.fromkeys(ROWS[name].model for name in _names(config)):
            model = _model(config, name)
            cells = [grid.train(task, seed, model).name for seed in config.train.seeds]
            add(found, task, _CALLED[name], cells, records)
    return found


def _training(config: ExperimentConfig) -> str:
    seeds = len(config.train.seeds)
    chance = (
        "Intervals are over scenarios, of this one training each: what another seed of the "
        "training would have changed is not in them."
        if seeds == 1
        else f"Intervals are over scenarios, with the {seeds} trainings as they are; in how many "
        "of these a claim holds is said beside."
    )
    return (
        f"All models were trained for {config.train.compared_steps} gradient steps on the same "
        "data with a head for rewards (`--policy.loss.reward=1`), and differ in the flags of their "
        "row only. Ours, Rew-MPC and TD-MPC with Q by Monte Carlo plan with one and the same "
        f"model. All rows play the same scenarios. {chance}"
    )


def _verdicts(cells: Cells, records: Mapping[str, Record]) -> list[Verdict]:
    found = []
    for claim in CLAIMS:
        for task in claim.tasks:
            rows = cells.get(task, {})
            above, below = rows.get(claim.above, {}), rows.get(claim.below, {})
            found.append(weigh(claim, task, above, below, records))
    return [verdict for verdict in found if verdict is not None]


def _shows(verdicts: Sequence[Verdict], found: Played) -> list[str]:
    lines = [by_chance(verdicts)] if verdicts else []
    for claim in CLAIMS:
        own = [f"{v.task} {v.words}" for v in verdicts if v.claim == claim]
        if own:
            lines.append(f"{_claimed(claim)}: {'; '.join(own)}")
    return lines + [line for task, rows in found.items() for line in _best_horizon(task, rows)]


def _claimed(claim: Claim) -> str:
    return f"{ROWS[claim.above].title} above {ROWS[claim.below].title}"


def _best_horizon(task: str, rows: Mapping[str, Outcome]) -> list[str]:
    ours = {n: rows[_horizon(n)] for n in _HORIZONS if _horizon(n) in rows}
    if OURS not in rows:
        return []
    success = f"{task}: {percent(rows[OURS].success_rate)} success at N=4"
    if len(ours) < 2:
        return [success]
    best = max(ours, key=lambda n: ours[n].reward_per_step)
    many = f"{success}; of N={', '.join(map(str, ours))} the most reward at N={best}"
    if ours[best] is rows[OURS]:
        return [many]
    gain, (low, high) = ours[best].reward_gain(rows[OURS])
    beyond = "beyond" if low > 0 else "not beyond"
    return [f"{many}, {beyond} chance ({gain:+.5f} beside N=4, 95 % {low:+.5f} to {high:+.5f})"]


def _summary(found: Played) -> Table:
    """As the paper prints it."""
    best = {t: max(o.reward_per_step for o in rows.values()) for t, rows in found.items()}
    lines = []
    for name in (name for name in ROWS if any(name in rows for rows in found.values())):
        cells = []
        for task, rows in found.items():
            played = rows.get(name)
            cells += ["-", "-", "-"] if played is None else _cells_of(played, best[task])
        lines.append((ROWS[name].title, *cells))
    heads = [h for task in found for h in (f"{task}: reward/step", "sd of trials", "success")]
    title = (
        "Reward per step, ± its standard deviation over trainings where there are several; a trial "
        "is a tenth of the scenarios with one training"
    )
    return Table(title, ("", *heads), tuple(lines))


def _cells_of(played: Outcome, best: float) -> list[str]:
    reward = f"{played.reward_per_step:+.4f}"
    reward = f"**{reward}**" if played.reward_per_step == best else reward
    spread = "" if played.reward_spread is None else f" ± {played.reward_spread:.4f}"
    trials = number(played.reward_trial_spread, ".4f")
    return [f"{reward}{spread}", trials, percent(played.success_rate)]


def _claims(verdicts: Sequence[Verdict]) -> Table:
    rows = tuple(
        (
            _claimed(v.claim),
            v.task,
            v.word,
            f"{v.reward:+.5f}",
            "{:+.5f} to {:+.5f}".format(*v.reward_interval),
            f"{v.agreeing} of {v.seeds}",
            f"{100 * v.success:+.1f}",
            points_range(v.success_interval),
            _of_wins(v),
            f"{_papers(v):+.4f}",
        )
        for v in verdicts
    )
    head = (
        "the paper's claim",
        "task",
        "here",
        "reward/step",
        "95 %",
        "trainings",
        "success (points)",
        "95 %",
        "reward/step where both succeed (95 %)",
        "the paper's reward",
    )
    return Table("Differences, above - below, on the same scenarios", head, rows)


def _of_wins(verdict: Verdict) -> str:
    if verdict.of_wins is None:
        return "-"
    gain, (low, high) = verdict.of_wins
    return f"{gain:+.5f} ({low:+.5f} to {high:+.5f})"


def _papers(verdict: Verdict) -> float:
    k = ("wall", "ball", "arch").index(verdict.task)
    return ROWS[verdict.claim.above].paper[k] - ROWS[verdict.claim.below].paper[k]


EXPERIMENT: Final = Experiment(
    "horizons, ARWM, Rew-MPC and TD-MPC beside ours; the paper's ordering weighed (table I)",
    _cells,
    _report,
)
