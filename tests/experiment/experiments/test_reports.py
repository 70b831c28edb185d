"""Reports of every experiment, without results and with closed-loop results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from egovcp.sim.config import EnvConfig
from egovcp_experiment.cell import ARTIFACT, COLLECT, PLAY, Cell, CellOutput
from egovcp_experiment.config import SCALES
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.experiments.generalise import _EDGES, conditions
from egovcp_experiment.report import ExperimentReport, Plot, Table
from egovcp_experiment.studies.plan_time import SEARCHES
from egovcp_experiment.studies.residuals import analysis

_PARTS = "env.sequence.parts"
_HORIZON_CELLS = ("play-ball-ours_n1-s0", "play-ball-ours_n4-s0")

CLOSED_LOOP = (
    "generalise",
    "multitask",
    "planners",
    "ppo",
    "sample-efficiency",
    "table1",
    "variance",
)


def played(cell: Cell) -> dict[str, Any]:
    """Random results that depend on the name of the cell."""
    rng = np.random.default_rng(sum(map(ord, cell.name)))
    count = 20
    parts = {part: (rng.random(count) < 0.7).tolist() for part in cell.flags.get(_PARTS, ())}
    return {
        cell.flags["task"]: {
            name: {
                "plan_ms_p50": 1.0,
                "played": {
                    "episode": list(range(count)),
                    "steps": [10] * count,
                    "reward": rng.normal(size=count).tolist(),
                    "success": (rng.random(count) < 0.5).tolist(),
                    **({"parts": parts} if parts else {}),
                },
            }
            for name in cell.flags["controllers"].split(",")
        }
    }


def records(name: str, share: float) -> dict[str, Mapping[str, Any]]:
    """Results of the first ``share`` of the plays, and of all collections."""
    cells = EXPERIMENTS[name].cells(SCALES["small"]())
    plays = [cell for cell in cells if cell.command is PLAY]
    found = {cell.name: {"metrics": played(cell)} for cell in plays[: round(share * len(plays))]}
    collected = {"metrics": {"episodes": 100, "steps": 15_000}}
    return {**{c.name: collected for c in cells if c.command is COLLECT}, **found}


@cache
def report(name: str, share: float) -> ExperimentReport:
    return EXPERIMENTS[name].report(SCALES["small"](), records(name, share))


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_report_works_without_results(name: str) -> None:
    found = EXPERIMENTS[name].report(SCALES["small"](), {})
    assert found.title
    assert found.findings == []
    assert not [part for part in found.sections if isinstance(part, Plot)]


@pytest.mark.parametrize("share", [0.4, 1.0])
@pytest.mark.parametrize("name", CLOSED_LOOP)
def test_tables_agree_with_their_heads(name: str, share: float) -> None:
    found = report(name, share)
    tables = [part for part in found.sections if isinstance(part, Table)]
    assert tables
    for table in tables:
        assert table.rows
        assert {len(row) for row in table.rows} == {len(table.head)}
    plots = [part for part in found.sections if isinstance(part, Plot)]
    assert len({plot.name for plot in plots}) == len(plots)


@pytest.mark.parametrize("name", CLOSED_LOOP)
def test_every_task_has_a_conclusion(name: str) -> None:
    found = report(name, 1.0)
    findings = " ".join([*found.lead, *found.findings])
    if name != "variance":  # its verdicts need residuals
        for task in ("ball", "wall", "arch"):
            assert f"{task}" in findings


@pytest.mark.parametrize("name", ["generalise", "planners"])
def test_pages_begin_with_three_sentences_and_a_plot(name: str) -> None:
    found = report(name, 1.0)
    assert len(found.lead) == 3
    assert found.plot is not None


@pytest.mark.parametrize("lost", [0, 6, 60])
def test_a_verdict_needs_the_whole_interval_on_one_side_of_the_bar(lost: int) -> None:
    """Scenes lost of 120, in one condition only."""
    found = records("generalise", 1.0)
    for cell in EXPERIMENTS["generalise"].cells(SCALES["small"]()):
        if cell.command is PLAY and cell.flags["controllers"] == "planner":
            row = found[cell.name]["metrics"][cell.flags["task"]]["planner"]["played"]
            failures = lost if "thickest" in cell.name else 0
            scenes = range(120)
            row |= {"episode": [*scenes], "steps": [100] * 120, "reward": [1.0] * 120}
            row["success"] = [k >= failures for k in scenes]
    made = EXPERIMENTS["generalise"].report(SCALES["small"](), found)
    tables = [part for part in made.sections if isinstance(part, Table)]
    (table,) = (t for t in tables if t.title == "arch: within the training ranges")
    verdicts = {row[0]: row[table.head.index("verdict")] for row in table.rows}
    words = {0: "at most 3 points lost", 6: "undecided", 60: "more than 3 points lost"}
    assert verdicts.pop("as_trained") == ""
    assert verdicts.pop("thickest") == words[lost]
    assert set(verdicts.values()) == {words[0]}
    worst = f"the worst is `thickest` of arch ({-100 * lost / 120:+.0f} points)"
    assert worst in made.lead[0] or not lost


def test_rewards_of_longer_episodes_are_not_compared() -> None:
    tables = [part for part in report("generalise", 1.0).sections if isinstance(part, Table)]
    (table,) = (t for t in tables if t.title == "arch: beyond the training ranges")
    for row in table.rows[1:]:
        shown = dict(zip(table.head, row, strict=True))
        dashes = [shown[name] == "-" for name in ("reward per step", "reward above as_trained")]
        assert dashes == [row[0] == "slower"] * 2
        assert shown["success above as_trained (points)"] != "-"


def option(flag: str) -> Any:
    """The default of an option of the environment."""
    value: Any = EnvConfig()
    for name in flag.split(".")[1:]:
        value = getattr(value, name)
    return value


@pytest.mark.parametrize("task", ["ball", "wall", "arch"])
def test_edges_are_within_the_training_ranges_and_the_others_beyond(task: str) -> None:
    for name, flags in conditions(SCALES["small"](), task).items():
        ranges = {
            flag: (value, option(flag)) for flag, value in flags.items() if isinstance(value, list)
        }
        within = [low <= a <= b <= high for (a, b), (low, high) in ranges.values()]
        assert (name in _EDGES[task] or name == "as_trained") == (
            all(within) and len(within) == len(flags)
        )


def generalised(**options: Any) -> list[Cell]:
    return EXPERIMENTS["generalise"].cells(replace(SCALES["small"](), **options))


def test_a_sequence_is_played_by_the_model_of_all_tasks() -> None:
    plays = [c for c in generalised() if c.command is PLAY and c.flags["task"] == "sequence"]
    planners = {c.name: c for c in plays if c.flags["controllers"] == "planner"}
    assert set(planners) == {
        "play-sequence-in_arch_then_ball-s0",
        "play-sequence-in_arch_then_box-s0",
        "play-sequence-in_arch_then_box_then_wall-s0",
    }
    assert len(plays) == 2 * len(planners)
    for cell in planners.values():
        assert cell.flags["policy.path"] == CellOutput("train-all-default-s0", ARTIFACT)
    box = planners["play-sequence-in_arch_then_box-s0"].flags
    assert (box[_PARTS], box["env.ball.shape"]) == (["arch", "ball"], "box")


def test_sequences_need_the_tasks_of_their_parts() -> None:
    def played(*tasks: str) -> set[str]:
        cells = generalised(tasks=tasks)
        return {c.name for c in cells if c.name.startswith("play-sequence")}

    assert played("ball", "wall") == set()
    assert len(played("ball", "arch")) == 2
    assert len(played("ball", "arch", "wall")) == 3


def test_only_chosen_conditions_and_their_reference_are_played() -> None:
    plays = [c for c in generalised(only=("arch_then_box",)) if c.command is PLAY]
    assert {c.flags["task"] for c in plays} == {"sequence"}
    assert len(plays) == 4
    cells = generalised(only=("radius_6cm",))
    assert {c.flags["task"] for c in cells if c.command is PLAY} == {"ball"}


def test_the_report_has_the_parts_of_a_sequence() -> None:
    found = report("generalise", 1.0)
    table = next(
        p for p in found.sections if isinstance(p, Table) and p.title.startswith("sequence")
    )
    assert {"planner's arch", "planner's ball", "planner's wall"} <= set(table.head)
    wall = table.head.index("planner's wall")
    assert [row[wall] == "-" for row in table.rows] == [True, True, False]


def test_multitask_names_the_models_that_were_not_trained() -> None:
    def words(policies: dict[str, str]) -> str:
        small = SCALES["small"]()
        config = replace(small, train=replace(small.train, policies=policies))
        return str(EXPERIMENTS["multitask"].report(config, records("multitask", 1.0)).sections[0])

    assert words({}).startswith("Every model was trained for equally many epochs, as in the paper:")
    some = words({"ball": "policy", "all": "me/model"})
    assert some.startswith("Every model except those given for ball, all (`--train.policies`) was")


def test_variance_compares_single_terms_with_the_planner() -> None:
    def term(reward: float, successes: int) -> Mapping[str, Any]:
        success = [k < successes for k in range(20)]
        return {"reward": [10 * reward] * 20, "steps": [10] * 20, "success": success}

    metrics = {
        "task": "ball",
        "horizon": 4,
        "terms": {"first": term(0.1, 9), "last": term(0.3, 20)},
        "return_std": 0.5,
        "spread": [0.05, 0.1, 0.15, 0.2],
    }
    cells = {c.name: c for c in EXPERIMENTS["variance"].cells(SCALES["small"]())}
    found = {
        "plan_terms-ball": {"metrics": metrics},
        **{name: {"metrics": played(cells[name])} for name in _HORIZON_CELLS},
    }
    for name, played_term in zip(_HORIZON_CELLS, (term(0.05, 8), term(0.2, 18)), strict=True):
        row = found[name]["metrics"]["ball"]["planner"]["played"]
        row |= played_term
    assert cells["plan_terms-ball"].flags["seed"] == cells[_HORIZON_CELLS[0]].flags["seed"]
    made = EXPERIMENTS["variance"].report(SCALES["small"](), found)
    spread, line = made.findings
    assert "0.10, 0.20, 0.30, 0.40 of" in spread
    assert line == (
        "ball: compared with the planner (90.0 %), by reward: one step worse (40.0 %), first term "
        "worse (45.0 %), last term better (100.0 %)"
    )
    assert made.metrics["ball"]["terms"]["last term"]["success_rate"] == 1.0
    alone = EXPERIMENTS["variance"].report(
        SCALES["small"](), {"plan_terms-ball": found["plan_terms-ball"]}
    )
    assert len(alone.findings) == 1


def test_variance_compares_its_prediction_with_the_same_model_in_closed_loop() -> None:
    found = records("variance", 1.0)
    errors = np.random.default_rng(0).normal(size=(100, 6))  # independent
    returns = np.zeros((100, 6, 2))
    plans = {"planner": analysis(errors, returns, returns)}
    found["residuals-ball"] = {"metrics": {"plans": plans}}
    for name, reward in (("ours_mc_n1", 0.1), ("ours_mc", 0.2)):
        row = found[f"play-ball-{name}-s0"]["metrics"]["ball"]["planner"]["played"]
        row["reward"] = [10 * reward] * 20
    cells = {c.name: c for c in EXPERIMENTS["variance"].cells(SCALES["small"]())}
    model = CellOutput("train-all-mc-s0", ARTIFACT)
    for name in ("residuals-ball", "play-ball-ours_mc_n1-s0", "play-ball-ours_mc-s0"):
        assert cells[name].flags["policy.path"] == model
    assert cells["plan_terms-ball"].flags["policy.path"] != model
    correlation, prediction, best = EXPERIMENTS["variance"].report(SCALES["small"](), found).lead
    assert "ball: correlation " in correlation
    assert prediction.endswith("ball N = 4, confirmed.")
    assert best.startswith("The default model earns the most reward at N = ")


def test_a_share_of_no_variance_is_a_dash() -> None:
    errors = np.random.default_rng(0).normal(size=(50, 6))
    errors[:, 0] = 0.0
    returns = np.random.default_rng(1).normal(size=(50, 6, 4))
    plans = {"planner": analysis(errors + returns.mean(2), returns, returns)}
    found = {"residuals-ball": {"metrics": {"plans": plans}}}
    made = EXPERIMENTS["variance"].report(SCALES["small"](), found)
    assert made.lead[0].endswith("), -.")


def test_ablations_name_the_best_choice() -> None:
    def record(gain: float) -> Mapping[str, Any]:
        errors = {str(k): {"model_mm": 1.0, "repeat_mm": gain} for k in (4, 8)}
        heldout = {
            "depth": dict.fromkeys(("moving", "near", "valid"), errors),
            "state": {"joint_position": {"4": {"model": 2.0, "repeat": 3.0}}},
            "termination": {"5": {"auc": None}},
            "value": {"r2": 0.3, "slope": 1.0},
            "latent": {"active": 20, "kl_nats": 3.0},
        }
        return {"metrics": {"tasks": {"ball": heldout}}}

    config = replace(SCALES["small"](), tasks=("ball",))
    config = replace(config, train=replace(config.train, seeds=(0, 1)))
    found = {
        "train-ball-default-s0": record(2.0),
        "train-ball-default-s1": record(4.0),
        "ablate-ball-value_two_hot-s1": record(5.0),
    }
    made = EXPERIMENTS["ablations"].report(config, found)
    words = "`value_two_hot` is best with 5; `default` has 3, place 2 of 2."
    assert made.lead == [f"ball, moving, 8 (x): {words}"]
    assert made.findings == [f"ball, all pixels, 8 (x): {words}"]
    assert made.plot is not None
    (table,) = (part for part in made.sections if isinstance(part, Table))
    rows = {row[0]: dict(zip(table.head, row, strict=True)) for row in table.rows}
    assert rows["default"]["Q R2"] == "0.3 ± 0"
    assert rows["default"]["moving, 8 (x)"] == "3 ± 1"
    assert rows["value_two_hot"]["AUC within 5"] == "-"
    of_all = {name.replace("-ball-", "-all-"): record for name, record in found.items()}
    both = EXPERIMENTS["ablations"].report(replace(config, tasks=("ball", "wall")), of_all)
    assert both.findings[-1] == "wall: no episode is held out, because its data has too few."


def test_searches_above_the_time_budget_are_named() -> None:
    row = {"samples": 32, "iterations": 3, "elites": 16, "plan_ms": 5.0, "within_budget": True}
    slow = {"cem_6": {**row, "plan_ms": 15.2, "within_budget": False}}
    timing = {"metrics": {"searches": dict.fromkeys(SEARCHES, row) | slow}}
    found = {**records("planners", 1.0), "plan_time-ball": timing}
    findings = EXPERIMENTS["planners"].report(SCALES["small"](), found).findings
    over = [line for line in findings if "fewest candidates" in line]
    assert over == ["ball, searches: above 12 ms even with the fewest candidates: `cem_6` 15.2 ms"]
