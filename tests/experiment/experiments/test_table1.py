"""Table I: its cells, shared models, and verdicts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egovcp.artifact import save_artifact
from egovcp.errors import UsageError
from egovcp.eval_scores import Gain
from egovcp.model import PRESETS, WorldModel
from egovcp.plan.config import PlannerConfig
from egovcp_experiment.cell import ARTIFACT, PLAY, TRAIN, Cell, CellOutput
from egovcp_experiment.config import SCALES, ExperimentConfig, TrainingConfig
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.experiments.claims import Claim, Verdict, count_verdicts, judge
from egovcp_experiment.report import ExperimentReport, Table

TABLE1 = EXPERIMENTS["table1"]
SEEDS = (0, 1)
COUNT = 40
CONFIG = ExperimentConfig(tasks=("ball", "wall"), train=TrainingConfig(seeds=SEEDS, steps=700))
CELLS = {cell.name: cell for cell in TABLE1.cells(CONFIG)}


def row(name: str, seed: int = 0, task: str = "ball") -> Cell:
    return CELLS[f"play-{task}-{name}-s{seed}"]


def planned(name: str) -> tuple[object, object]:
    flags = row(name).flags
    return flags["planner.objective"], flags["planner.horizon"]


def test_rows_set_objective_and_horizon() -> None:
    assert [planned(f"ours_n{n}") for n in range(1, 7)] == [("value", n) for n in range(1, 7)]
    assert planned("arwm") == planned("ours_mc") == planned("no_multistep") == ("value", 4)
    assert planned("rew_mpc") == ("reward", 4)
    assert planned("td_mpc") == planned("td_mpc_td") == planned("td_mpc_td_long") == ("td", 4)


def test_rows_share_models() -> None:
    ours = CellOutput("train-all-default-s1", ARTIFACT)
    for name in (*(f"ours_n{n}" for n in range(1, 7)), "rew_mpc", "td_mpc"):
        assert row(name, 1).flags["policy.path"] == ours
    for name, model in (("arwm", "arwm"), ("td_mpc_td", "td"), ("ours_mc", "mc")):
        assert row(name, 1).flags["policy.path"] == CellOutput(f"train-all-{model}-s1", ARTIFACT)
    assert sum(cell.command is TRAIN for cell in CELLS.values()) == 5 * len(SEEDS) + 1


def test_models_differ_in_one_flag() -> None:
    joint, arwm, td = (CELLS[f"train-all-{name}-s0"].flags for name in ("default", "arwm", "td"))
    assert joint["policy.loss.reward"] == "1"
    assert joint["steps"] == 700
    assert arwm == {**joint, "policy.dynamics": "autoregressive"}
    assert td == {**joint, "policy.loss.q_target": "td"}
    assert CELLS["train-all-td_x3-s0"].flags == {**td, "steps": 2100}
    assert "train-all-td_x3-s1" not in CELLS


def test_all_rows_and_references_play_the_same_scenarios() -> None:
    plays = [c for c in CELLS.values() if c.command is PLAY and c.flags["task"] == "ball"]
    assert len(plays) == 12 * len(SEEDS) + 2
    assert {(c.flags["episodes"], c.flags["seed"]) for c in plays} == {(100, 20)}


def test_a_smoke_run_has_each_of_the_models() -> None:
    cells = TABLE1.cells(replace(SCALES["smoke"](), tasks=("ball",)))
    assert [c.name for c in cells if c.command is TRAIN] == [
        "train-ball-default-s0",
        "train-ball-arwm-s0",
        "train-ball-td-s0",
    ]


def test_a_model_without_a_reward_head_is_refused_if_rows_plan_with_rewards(
    tmp_path: Path,
) -> None:
    policy = tmp_path / "policy"
    model = WorldModel(PRESETS["debug"])
    save_artifact(policy, model, PlannerConfig(), {"controller_id": "servo-1"})
    given = replace(CONFIG, train=replace(CONFIG.train, policies={"all": str(policy)}))
    with pytest.raises(UsageError, match=r"--train\.policies: row rew_mpc"):
        TABLE1.cells(given)
    assert TABLE1.cells(replace(given, only=("ours_n4",)))
    with pytest.raises(UsageError, match=r"--train\.flags: row td_mpc_td"):
        TABLE1.cells(replace(CONFIG, train=replace(CONFIG.train, flags=("--batch_size=32",))))


def record(task: str, reward: float, success: float, rng: np.random.Generator) -> Mapping[str, Any]:
    """Ten ticks an episode, with a little noise."""
    played = {
        "episode": list(range(COUNT)),
        "steps": [10] * COUNT,
        "reward": (10 * reward + rng.normal(0, 0.05, COUNT)).tolist(),
        "success": [k < success * COUNT for k in range(COUNT)],
        "terms": {"hit": [-1.0] * COUNT, "pose": [0.5] * COUNT},
    }
    return {"metrics": {task: {"planner": {"played": played, "plan_ms_p50": 1.0}}}}


def results(reward: Callable[[str, str, int], float]) -> dict[str, Mapping[str, Any]]:
    """Of the plays of all rows: ``reward(task, row, seed)`` per step."""
    rng = np.random.default_rng(2)
    found = {}
    for name, cell in CELLS.items():
        if cell.command is PLAY and cell.flags["controllers"] == "planner":
            _, task, variant, seed = name.split("-")
            level = reward(task, variant, int(seed[1:]))
            found[name] = record(task, level, 0.5 + level, rng)
    return found


def as_in_the_paper(task: str, variant: str, seed: int) -> float:
    """N=4 above all, but for TD-MPC, which is above it on the wall."""
    best = {"ball": ("ours_n4",), "wall": ("td_mpc", "td_mpc_td")}[task]
    return 0.2 if variant in best else 0.1 if variant == "ours_n4" else 0.0


def report(reward: Callable[[str, str, int], float]) -> ExperimentReport:
    return TABLE1.report(CONFIG, results(reward))


def words(found: ExperimentReport) -> set[tuple[str, str, str, str]]:
    return {(c["above"], c["below"], c["task"], c["verdict"]) for c in found.metrics["claims"]}


def test_the_papers_ordering_is_recognised() -> None:
    found = report(as_in_the_paper)
    assert words(found) == {
        ("ours_n4", "ours_n1", "ball", "holds"),
        ("ours_n4", "ours_n1", "wall", "holds"),
        ("ours_n4", "rew_mpc", "ball", "holds"),
        ("ours_n4", "rew_mpc", "wall", "holds"),
        ("ours_n4", "arwm", "ball", "holds"),
        ("ours_n4", "td_mpc", "ball", "holds"),
        ("td_mpc", "ours_n4", "wall", "holds"),
        ("ours_n4", "td_mpc_td", "ball", "holds"),
        ("td_mpc_td", "ours_n4", "wall", "holds"),
    }
    assert found.lead == [
        "Ours (N = 4) blocks 70.0 % of the balls and braces in 60.0 % of the pushes.",
        "Of the paper's 9 claims 9 hold.",
        "Of the horizons the most reward is earned by N = 4 (ball) and N = 4 (wall).",
    ]
    assert "about 0.2 of the 9 claims would hold" in found.findings[0]


def test_the_plot_needs_the_references() -> None:
    cells = results(as_in_the_paper)
    assert TABLE1.report(CONFIG, cells).plot is None
    rng = np.random.default_rng(0)
    bounds: dict[str, Any] = {}
    for name, level in (("hold", 0.0), ("random", 0.0), ("oracle", 0.3)):
        bounds[name] = record("ball", level, 0.5, rng)["metrics"]["ball"]["planner"]
    plot = TABLE1.report(CONFIG, cells | {"bounds-ball": {"metrics": {"ball": bounds}}}).plot
    assert plot is not None
    assert "ours, N=4 above ARWM: ball" in plot.svg
    assert "wall" not in plot.svg


def test_the_terms_of_the_reward_are_listed() -> None:
    tables = [p for p in report(as_in_the_paper).sections if isinstance(p, Table)]
    (terms,) = [table for table in tables if table.title == "ball: reward per step by term"]
    assert terms.head == ("", "hit", "pose")
    assert ("ARWM", "-0.10000", "+0.05000") in terms.rows


def test_the_opposite_is_contradicted_and_equality_is_undecided() -> None:
    opposite = report(lambda *cell: -as_in_the_paper(*cell))
    assert {word for *_, word in words(opposite)} == {"contradicted"}
    same = report(lambda *cell: 0.0)
    assert {word for *_, word in words(same)} == {"undecided"}


def test_a_claim_that_fails_in_one_training_holds_on_average_only() -> None:
    found = report(lambda task, variant, seed: (0.3, -0.1)[seed] if variant == "ours_n4" else 0.0)
    assert ("ours_n4", "ours_n1", "ball", "holds on average only") in words(found)
    found = report(lambda task, variant, seed: (0.1, -0.3)[seed] if variant == "ours_n4" else 0.0)
    assert ("ours_n4", "ours_n1", "ball", "contradicted on average only") in words(found)
    claims = [part for part in found.sections if isinstance(part, Table)][1]
    assert claims.rows[0][6] == "1 of 2"


def test_the_longer_training_is_compared_with_the_first_seed_of_the_others() -> None:
    levels = {"td_mpc_td_long": 0.1, "ours_n4": 0.2, "td_mpc_td": 0.0}
    found = report(lambda task, variant, seed: levels.get(variant, 0.0) + 10.0 * seed)
    assert found.findings[1:] == [
        "With the first training seed and by reward, TD-MPC, Q by TD, 3 x the steps, is better on "
        "ball and wall than TD-MPC, Q by TD.",
        "With the first training seed and by reward, TD-MPC, Q by TD, 3 x the steps, is worse on "
        "ball and wall than ours, N=4.",
    ]


def test_the_summary_marks_the_best_and_has_the_deviation_of_trainings() -> None:
    found = report(lambda task, variant, seed: 0.2 + 0.1 * seed if variant == "arwm" else 0.0)
    summary = next(part for part in found.sections if isinstance(part, Table))
    (arwm,) = [line for line in summary.rows if line[0] == "ARWM"]
    mean, _, spread = arwm[1].partition(" ± ")
    assert float(mean.strip("*")) == pytest.approx(0.25, abs=0.01)
    assert float(spread) == pytest.approx(0.1 / np.sqrt(2), abs=0.01)
    assert [line[0] for line in summary.rows if line[1].startswith("**")] == ["ARWM"]


def test_a_claim_uses_the_trainings_of_both_rows() -> None:
    rng = np.random.default_rng(0)
    records = {
        "a0": record("ball", 0.0, 0.5, rng),
        "a1": record("ball", 0.9, 0.9, rng),
        "b0": record("ball", 0.0, 0.5, rng),
    }
    claim = Claim("a", "b", ("ball",))
    rows = {"a": ["a0", "a1"], "b": ["b0", "b1"]}
    verdict = judge(claim, "ball", rows, records)
    assert verdict is not None
    assert (len(verdict.differences), verdict.word, verdict.gain.success) == (1, "undecided", 0.0)
    assert verdict.over_trainings is None
    assert judge(claim, "ball", {"a": ["a1"], "b": ["b1"]}, records) is None


GAIN = Gain(1.0, (0.5, 1.5), 0.0, (0.0, 0.0))


def test_verdicts_are_counted() -> None:
    up = Verdict(Claim("a", "b", ("ball",)), "ball", GAIN, (1.0,))
    even = replace(up, gain=GAIN._replace(reward_interval=(-0.1, 0.1)))
    assert count_verdicts([up] * 3 + [even] * 17) == "3 hold and 17 are undecided"
    assert count_verdicts([up, even, replace(up, differences=(-1.0, 2.0))]) == (
        "1 holds, 1 holds on average only and 1 is undecided"
    )


def test_the_interval_over_trainings_is_students() -> None:
    verdict = Verdict(Claim("a", "b", ("ball",)), "ball", GAIN, (0.1, 0.2, 0.3))
    assert verdict.over_trainings == pytest.approx((0.2, 4.303 * 0.1 / np.sqrt(3)))
