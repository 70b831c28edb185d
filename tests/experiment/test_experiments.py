"""Reports of every experiment: from nothing, and from whatever closed-loop results there are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egovcp.artifact import save_artifact
from egovcp.plan import PlannerConfig
from egovcp.testing import toy_model
from egovcp_experiment.cell import Cell, Output
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.report.document import Plot, Report, Table
from egovcp_experiment.scales import SCALES
from egovcp_experiment.studies.open_loop import HORIZONS
from egovcp_experiment.tools import ARTIFACT, COLLECT, PLAY

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
    """What a play might have been: who plays better in some cells than in others."""
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
    plays = [cell for cell in cells if cell.tool is PLAY]
    found = {cell.name: {"figures": played(cell)} for cell in plays[: round(share * len(plays))]}
    collected = {"figures": {"episodes": 100, "steps": 15_000}}
    return {**{c.name: collected for c in cells if c.tool is COLLECT}, **found}


def report(name: str, share: float) -> Report:
    return EXPERIMENTS[name].report(SCALES["small"](), records(name, share))


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_with_nothing_to_report_there_is_a_report(name: str) -> None:
    found = EXPERIMENTS[name].report(SCALES["small"](), {})
    assert found.title
    assert found.shows == ()
    assert not [part for part in found.parts if isinstance(part, Plot)]


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("name", CLOSED_LOOP)
def test_tables_hold_what_is_there_and_agree_with_their_heads(name: str, share: float) -> None:
    found = report(name, share)
    tables = [part for part in found.parts if isinstance(part, Table)]
    assert tables
    for table in tables:
        assert table.rows
        assert {len(row) for row in table.rows} == {len(table.head)}
    plots = [part for part in found.parts if isinstance(part, Plot)]
    assert len({plot.name for plot in plots}) == len(plots)


@pytest.mark.parametrize("name", CLOSED_LOOP)
def test_every_task_has_a_verdict(name: str) -> None:
    shows = " ".join(report(name, 1.0).shows)
    if name != "variance":  # its verdicts need residuals
        for task in ("ball", "wall", "arch"):
            assert f"{task}" in shows


def test_a_loss_is_called_one() -> None:
    """Half of the scenes lost, in one condition only."""
    found = records("generalise", 1.0)
    for cell in EXPERIMENTS["generalise"].cells(SCALES["small"]()):
        if cell.tool is PLAY and cell.flags["controllers"] == "planner":
            row = found[cell.name]["figures"][cell.flags["task"]]["planner"]["played"]
            row["success"] = [True] * 20 if "box" not in cell.name else [False] * 10 + [True] * 10
    shows = EXPERIMENTS["generalise"].report(SCALES["small"](), found).shows
    assert "ball: worse by more than chance, points: `box` -50" in shows
    assert not [line for line in shows if line.startswith("wall: worse")]


def generalised(**options: Any) -> list[Cell]:
    return EXPERIMENTS["generalise"].cells(replace(SCALES["small"](), **options))


def test_a_sequence_is_played_by_the_model_of_all_tasks() -> None:
    plays = [c for c in generalised() if c.tool is PLAY and c.flags["task"] == "sequence"]
    planners = {c.name: c for c in plays if c.flags["controllers"] == "planner"}
    assert set(planners) == {
        "play-sequence-in_arch_then_ball-s0",
        "play-sequence-in_arch_then_box-s0",
        "play-sequence-in_arch_then_box_then_wall-s0",
    }
    assert len(plays) == 2 * len(planners)
    for cell in planners.values():
        assert cell.flags["policy.path"] == Output("train-all-default-s0", ARTIFACT)
    box = planners["play-sequence-in_arch_then_box-s0"].flags
    assert (box[_PARTS], box["env.ball.shape"]) == (["arch", "ball"], "box")


def test_sequences_need_the_tasks_they_are_made_of() -> None:
    def played(*tasks: str) -> set[str]:
        cells = generalised(tasks=tasks)
        return {c.name for c in cells if c.name.startswith("play-sequence")}

    assert played("ball", "wall") == set()
    assert len(played("ball", "arch")) == 2
    assert len(played("ball", "arch", "wall")) == 3


def test_only_what_is_asked_for_is_played_beside_what_it_is_compared_with() -> None:
    plays = [c for c in generalised(only=("arch_then_box",)) if c.tool is PLAY]
    assert {c.flags["task"] for c in plays} == {"sequence"}
    assert len(plays) == 4
    assert {c.flags["task"] for c in generalised(only=("small",)) if c.tool is PLAY} == {"ball"}


def test_the_report_tells_the_parts_of_a_sequence_apart() -> None:
    found = report("generalise", 1.0)
    assert [line for line in found.shows if line.startswith("sequence: parts won in")]
    table = next(p for p in found.parts if isinstance(p, Table) and p.title.startswith("sequence"))
    assert {"planner's arch", "planner's ball", "planner's wall"} <= set(table.head)
    wall = table.head.index("planner's wall")
    assert [row[wall] == "-" for row in table.rows] == [True, True, False]


def test_multitask_says_which_models_are_played_otherwise() -> None:
    assert "played with" not in str(report("multitask", 1.0).parts[0])
    small = SCALES["small"]()
    flags = {
        "wall": ("--planner.action_parameterization=random_walk", "--planner.hands_cost=0.3"),
        "all": ("--planner.elites=8",),
    }
    unlike = replace(small, play=replace(small.play, task_flags=flags))
    found = EXPERIMENTS["multitask"].report(unlike, records("multitask", 1.0))
    assert str(found.parts[0]).endswith(
        "The model of wall alone is played with "
        "`--planner.action_parameterization=random_walk --planner.hands_cost=0.3`. "
        "The model on mixed data is played with `--planner.elites=8`."
    )


def test_multitask_says_for_how_long_models_were_trained(tmp_path: Path) -> None:
    def words(policies: dict[str, str]) -> str:
        small = SCALES["small"]()
        config = replace(small, train=replace(small.train, policies=policies))
        return str(EXPERIMENTS["multitask"].report(config, records("multitask", 1.0)).parts[0])

    assert words({}).startswith("Every model was trained for 10 minutes: the one on mixed data")
    policy = str(tmp_path / "policy")
    entries = {"controller_id": "stance-1", "step": 4321}
    save_artifact(Path(policy), toy_model(), PlannerConfig(), entries)
    some = words({"ball": policy, "all": "me/model"})
    assert "of ball alone, 4321 gradient steps; on mixed data, `me/model`. Every other" in some
    every = words(dict.fromkeys(("ball", "wall", "arch", "all"), policy))
    assert "10 minutes" not in every


def test_interpret_reports_the_ball_in_decoded_images() -> None:
    def errors(k: int) -> dict[str, Any]:
        everywhere = {"model": 0.1, "repeat": 0.2, "model_moving": None, "repeat_moving": None}
        ball = {"ball_images": 5, "model_ball": k / 10, "repeat_ball": k / 5, "ball_detected": 0.6}
        gone = {"ball_images": 0, "model_ball": None, "repeat_ball": None, "ball_detected": None}
        return {**everywhere, **(ball if k < 16 else gone)}

    found = {"episodes": 5, "errors_m": {str(k): errors(k) for k in HORIZONS}, "strips": []}
    made = EXPERIMENTS["interpret"].report(
        SCALES["small"](), {"open_loop-ball": {"figures": found}}
    )
    assert made.shows == (
        "ball: 4, 8, 12, 16 ticks ahead, the depth of the ball in the decoded image is off by "
        "40, 80, 120, - cm; repeating the last picture by 80, 160, 240, - cm",
    )
    _, table = (part for part in made.parts if isinstance(part, Table))
    assert table.rows[4] == ("8", "5", "80.0", "160.0", "60.0 %")
    assert table.rows[8] == ("16", "0", "-", "-", "-")
