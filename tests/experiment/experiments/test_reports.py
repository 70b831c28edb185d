"""Reports of every experiment, without results and with closed-loop results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from egovcp_experiment.cell import ARTIFACT, COLLECT, PLAY, Cell, CellOutput
from egovcp_experiment.config import SCALES
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.experiments.interpret import _edges
from egovcp_experiment.report import ExperimentReport, Plot, Table
from egovcp_experiment.studies.plan_time import SEARCHES

_PARTS = "env.sequence.parts"

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
    found = {cell.name: {"figures": played(cell)} for cell in plays[: round(share * len(plays))]}
    collected = {"figures": {"episodes": 100, "steps": 15_000}}
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
    findings = " ".join(report(name, 1.0).findings)
    if name != "variance":  # its verdicts need residuals
        for task in ("ball", "wall", "arch"):
            assert f"{task}" in findings


def test_a_significant_loss_is_reported() -> None:
    """Half of the scenes lost, in one condition only."""
    found = records("generalise", 1.0)
    for cell in EXPERIMENTS["generalise"].cells(SCALES["small"]()):
        if cell.command is PLAY and cell.flags["controllers"] == "planner":
            row = found[cell.name]["figures"][cell.flags["task"]]["planner"]["played"]
            row["success"] = [True] * 20 if "box" not in cell.name else [False] * 10 + [True] * 10
    findings = EXPERIMENTS["generalise"].report(SCALES["small"](), found).findings
    assert "ball: worse by more than chance, points: `box` -50" in findings
    assert not [line for line in findings if line.startswith("wall: worse")]


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
    assert [line for line in found.findings if line.startswith("sequence: parts won in")]
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

    assert words({}).startswith("Every model was trained for 3000 gradient steps: the one on")
    some = words({"ball": "policy", "all": "me/model"})
    assert some.startswith("Every model except those given for ball, all (`--train.policies`) was")


def test_variance_compares_single_terms_with_their_mean() -> None:
    def term(reward: float, successes: int) -> Mapping[str, Any]:
        success = [k < successes for k in range(20)]
        return {"reward": [10 * reward] * 20, "steps": [10] * 20, "success": success}

    figures = {
        "task": "ball",
        "horizon": 4,
        "terms": {"mean": term(0.2, 18), "first": term(0.1, 9), "last": term(0.3, 20)},
        "return_std": 0.5,
        "spread": [0.05, 0.1, 0.15, 0.2],
    }
    found = EXPERIMENTS["variance"].report(
        SCALES["small"](), {"plan_terms-ball": {"figures": figures}}
    )
    (line,) = found.findings
    assert line.startswith("ball: compared with the mean of Q over a plan (90.0%), by reward: ")
    assert "first term worse (45.0%), last term better (100.0%)" in line
    assert "0.10, 0.20, 0.30, 0.40 of" in line
    assert found.figures["ball"]["terms"]["last"]["success_rate"] == 1.0


@pytest.mark.parametrize(
    ("empty", "after", "words"),
    [
        ((0.02, 0.04), (0.05, 0.09), "raised for the ball"),
        ((0.02, 0.04), (0.03, 0.09), "not raised"),
        ((0.25, 0.30), (0.40, 0.50), "raised in empty scenes, too"),
    ],
)
def test_intervals_decide_whether_hands_are_raised(
    empty: tuple[float, float], after: tuple[float, float], words: str
) -> None:
    figures: dict[str, Any] = {
        name: {"mean": sum(ci95) / 2, "ci95": list(ci95), "episodes": 20}
        for name, ci95 in (("empty_scene", empty), ("after_throw", after))
    }
    found = EXPERIMENTS["interpret"].report(
        SCALES["small"](), {"behaviour-ball": {"figures": figures}}
    )
    (line,) = found.findings
    assert line.endswith(f"after a throw: {words}")


def test_the_cells_of_a_value_map_are_around_their_centres() -> None:
    assert _edges([0.0, 0.5, 1.0]) == (-0.25, 1.25)


def test_ablations_name_the_best_choice() -> None:
    def record(r2: float) -> Mapping[str, Any]:
        errors = {str(k): {"model_mm": 1.0, "repeat_mm": 4.0} for k in (4, 8)}
        heldout = {
            "depth": dict.fromkeys(("moving", "near", "valid"), errors),
            "state": {"joint_position": {"4": {"model": 2.0, "repeat": 3.0}}},
            "termination": {"5": {"auc": None}},
            "value": {"r2": r2, "slope": 1.0},
            "latent": {"active": 20, "kl_nats": 3.0},
        }
        return {"figures": {"tasks": {"ball": heldout}}}

    config = replace(SCALES["small"](), tasks=("ball",))
    config = replace(config, train=replace(config.train, seeds=(0, 1)))
    found = {
        "ablate-ball-default-s0": record(0.2),
        "ablate-ball-default-s1": record(0.4),
        "ablate-ball-td-s1": record(0.5),
    }
    made = EXPERIMENTS["ablations"].report(config, found)
    assert made.findings[-1] == "ball, Q R2: `td` is best with 0.5; `default` has 0.3, place 2 of 2"
    (table,) = (part for part in made.sections if isinstance(part, Table))
    rows = {row[0]: dict(zip(table.head, row, strict=True)) for row in table.rows}
    assert rows["default"]["Q R2"] == "0.3 ± 0.1"
    assert rows["default"]["moving, 8 (x)"] == "4 ± 0"
    assert rows["td"]["AUC within 5"] == "-"


def test_searches_above_the_time_budget_are_named() -> None:
    row = {"samples": 32, "iterations": 3, "elites": 16, "plan_ms": 5.0, "within_budget": True}
    slow = {"cem_6": {**row, "plan_ms": 15.2, "within_budget": False}}
    timing = {"figures": {"searches": dict.fromkeys(SEARCHES, row) | slow}}
    found = {**records("planners", 1.0), "plan_time-ball": timing}
    findings = EXPERIMENTS["planners"].report(SCALES["small"](), found).findings
    over = [line for line in findings if "fewest candidates" in line]
    assert over == ["ball, searches: above 12 ms even with the fewest candidates: `cem_6` 15.2 ms"]
