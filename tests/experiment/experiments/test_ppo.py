"""PPO's cells, digests and conclusions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from egovcp.errors import UsageError
from egovcp.files import write_json
from egovcp_experiment.cell import PPO_POLICY, TRAIN_PPO, CellOutput
from egovcp_experiment.config import (
    DataConfig,
    ExperimentConfig,
    PpoBaselineConfig,
    TrainingConfig,
)
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.store import CellStore

PPO = EXPERIMENTS["ppo"]
CONFIG = ExperimentConfig(
    output_dir="out",
    tasks=("ball",),
    scenes=("--env.controller=stance",),
    train=TrainingConfig(seeds=(3,)),
    ppo=PpoBaselineConfig(steps=1000, policies=2, robots=10, ticks=5, flags=("--threads=1",)),
)


def test_played_policies_are_saved_ones() -> None:
    cells = {cell.name: cell for cell in PPO.cells(CONFIG)}
    training = cells["ppo-ball-s3"]
    argv = CellStore(Path("out")).prepare(training)
    assert argv == [
        "--output_dir=out/work/ppo-ball-s3",
        "--task=ball",
        "--steps=1000",
        "--robots=10",
        "--ppo.num_steps_per_env=5",
        "--save_freq=10",
        "--seed=3",
        "--env.controller=stance",
        "--threads=1",
    ]
    plays = [cells[f"play-ball-ppo_{seen}-s3"] for seen in (500, 1000)]
    assert [play.flags["ppo.path"] for play in plays] == [
        CellOutput("ppo-ball-s3", f"checkpoints/{iteration}/{PPO_POLICY}")
        for iteration in ("000010", "000020")
    ]
    planner = cells["play-ball-default-s3"]
    for play in (*plays, cells["bounds-ball"]):
        assert [play.flags[k] for k in ("task", "episodes", "seed", "env.controller")] == [
            planner.flags[k] for k in ("task", "episodes", "seed", "env.controller")
        ]


def test_transitions_are_whole_updates_equally_far_apart() -> None:
    assert PpoBaselineConfig(steps=200_000).transitions == (49_600, 99_200, 148_800, 198_400)
    assert PpoBaselineConfig(steps=1, policies=2).transitions == (1600, 3200)
    assert PpoBaselineConfig(steps=0).transitions == ()


def test_the_report_needs_a_training() -> None:
    with pytest.raises(UsageError, match=r"--ppo\.steps=0"):
        PPO.cells(replace(CONFIG, ppo=PpoBaselineConfig(steps=0)))


def test_sample_efficiency_shares_the_trainings() -> None:
    ours = {cell.name: cell for cell in PPO.cells(CONFIG)}
    curves = {cell.name: cell for cell in EXPERIMENTS["sample-efficiency"].cells(CONFIG)}
    shared = {"ppo-ball-s3", "play-ball-ppo_500-s3", "play-ball-ppo_1000-s3", "bounds-ball"}
    assert {name for name in curves if "ppo" in name or name in ours} >= shared
    assert all(curves[name] == ours[name] for name in shared)
    no_ppo = replace(CONFIG, ppo=PpoBaselineConfig(steps=0))
    without = EXPERIMENTS["sample-efficiency"].cells(no_ppo)
    assert not [cell for cell in without if "ppo" in cell.name]


def test_every_saved_policy_changes_the_digest(tmp_path: Path) -> None:
    for iteration in ("000010", "000020"):
        file = tmp_path / "checkpoints" / iteration / PPO_POLICY
        file.parent.mkdir(parents=True)
        file.write_text(iteration)
    (tmp_path / "checkpoints" / "last").symlink_to("000020")
    before = TRAIN_PPO.digest(tmp_path)
    assert TRAIN_PPO.digest(tmp_path) == before
    (tmp_path / "checkpoints" / "000010" / PPO_POLICY).write_text("another")
    assert TRAIN_PPO.digest(tmp_path) != before


def played(name: str, success: int, reward: float) -> Mapping[str, Any]:
    columns = {
        "episode": list(range(20)),
        "steps": [10] * 20,
        "reward": [reward + 0.01 * (k % 3) for k in range(20)],
        "success": [k < success for k in range(20)],
    }
    return {name: {"plan_ms_p50": 1.0, "played": columns}}


def results() -> dict[str, Mapping[str, Any]]:
    return {
        "collect-ball-5400": {"metrics": {"episodes": 5400, "steps": 200_100}},
        "play-ball-default-s3": {"metrics": {"ball": played("planner", 18, 1.0)}},
        "play-ball-ppo_500-s3": {"metrics": {"ball": played("ppo", 5, 0.2)}},
        "play-ball-ppo_1000-s3": {"metrics": {"ball": played("ppo", 10, 0.2)}},
        "bounds-ball": {
            "metrics": {
                "ball": {
                    **played("hold", 2, 0.1),
                    **played("random", 2, 0.0),
                    **played("oracle", 20, 2.0),
                }
            }
        },
    }


def test_conclusions_follow_from_the_scores() -> None:
    found = PPO.report(CONFIG, results())
    assert found.lead == [
        "The planner succeeds in 90.0 % of ball.",
        "PPO succeeds in 50.0 % of ball after 1000 transitions.",
        "By reward, compared with the planner, PPO is worse on ball.",
    ]
    assert found.findings == [
        "ball: by reward, the last policy of PPO is better compared with the neutral pose and "
        "no different beyond chance compared with its first policy."
    ]
    assert found.metrics["ball"]["planner_transitions"] == 200_100


def test_the_transitions_of_a_given_dataset_are_counted(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    write_json(tmp_path / "meta" / "info.json", {"total_episodes": 40, "total_frames": 3210})
    config = replace(CONFIG, data=DataConfig(roots={"ball": str(tmp_path)}))
    found = PPO.report(config, results())
    assert found.metrics["ball"]["planner_transitions"] == 3210


def test_the_transitions_of_a_given_policy_are_unknown() -> None:
    config = replace(CONFIG, train=replace(CONFIG.train, policies={"ball": "a/ball"}))
    found = PPO.report(config, results())
    assert "planner_transitions" not in found.metrics["ball"]
    assert len(found.lead) == 3
