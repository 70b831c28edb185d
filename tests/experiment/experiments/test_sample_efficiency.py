"""Figure 5: conclusions about more data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egovcp.errors import UsageError
from egovcp.files import write_json
from egovcp_experiment.cell import TRAIN
from egovcp_experiment.config import (
    DataConfig,
    ExperimentConfig,
    PpoBaselineConfig,
    TrainingConfig,
)
from egovcp_experiment.experiments import EXPERIMENTS

COUNT = 40
CONFIG = ExperimentConfig(
    tasks=("wall",),
    data=DataConfig(parts=(0.5, 1.0)),
    train=TrainingConfig(seeds=(0,)),
    ppo=PpoBaselineConfig(steps=0),
)


def played(reward: float, success: float) -> Mapping[str, Any]:
    """Ten ticks an episode."""
    rng = np.random.default_rng(0)
    result = {
        "episode": list(range(COUNT)),
        "steps": [10] * COUNT,
        "reward": (10 * reward + rng.normal(0, 0.1, COUNT)).tolist(),
        "success": [k < success * COUNT for k in range(COUNT)],
    }
    return {"figures": {"wall": {"planner": {"played": result, "plan_ms_p50": 1.0}}}}


@pytest.mark.parametrize(
    ("reward", "words"),
    [(0.3, "helps"), (0.1, "hurts"), (0.2, "makes no clear difference")],
)
def test_more_data_is_judged_by_reward(reward: float, words: str) -> None:
    half, whole = [
        cell.name
        for cell in EXPERIMENTS["sample-efficiency"].cells(CONFIG)
        if cell.name.startswith("play-")
    ]
    records = {half: played(0.2, 0.9), whole: played(reward, 0.7)}
    assert EXPERIMENTS["sample-efficiency"].report(CONFIG, records).lead == [
        "Success with more data: 90.0 % (200k steps) to 70.0 % (400k steps) on wall.",
        f"By reward, more data {words} on wall.",
    ]


@pytest.mark.parametrize(
    ("seeds", "steps", "words"),
    [((0,), 64, "of 1 training. "), ((0, 1), 64, "of 2 trainings. "), ((0, 1), 0, "one task.")],
)
def test_ppo_is_described_if_it_is_trained(seeds: tuple[int, ...], steps: int, words: str) -> None:
    ppo, train = PpoBaselineConfig(steps=steps), TrainingConfig(seeds=seeds)
    config = replace(CONFIG, ppo=ppo, train=train)
    introduction = str(EXPERIMENTS["sample-efficiency"].report(config, {}).sections[0])
    assert words in introduction
    assert ("PPO" in introduction) == bool(steps)


def test_parts_are_prefixes_of_one_dataset() -> None:
    data = DataConfig(parts=(2.0, 0.5))
    config = ExperimentConfig(tasks=("ball",), data=data, train=TrainingConfig(seeds=(0,)))
    cells = {c.name: c for c in EXPERIMENTS["sample-efficiency"].cells(config)}
    assert cells["collect-ball-10800"].flags["episodes"] == 10800
    parts = [c.flags["dataset.episodes"] for c in cells.values() if c.command is TRAIN]
    assert parts == ["0:2700", "0:10800"]


def test_a_given_policy_is_not_the_model_of_all_episodes() -> None:
    training = TrainingConfig(seeds=(0,), policies={"all": "a/all"})
    config = ExperimentConfig(tasks=("ball", "wall"), data=DataConfig(parts=(1.0,)), train=training)
    cells = EXPERIMENTS["sample-efficiency"].cells(config)
    trained = [cell.name for cell in cells if cell.command is TRAIN]
    assert trained == ["train-all-part_1-s0"]
    (parts,) = (cell.flags["datasets"] for cell in cells if cell.command is TRAIN)
    assert [part["episodes"] for part in parts] == ["0:5400", "0:4000"]


def test_parts_are_those_of_a_given_dataset(tmp_path: Path) -> None:
    info = {"total_episodes": 1000, "total_frames": 80_000}
    (tmp_path / "meta").mkdir()
    write_json(tmp_path / "meta" / "info.json", info)
    roots = {"wall": str(tmp_path)}
    config = replace(CONFIG, data=replace(CONFIG.data, roots=roots))
    cells = EXPERIMENTS["sample-efficiency"].cells(config)
    parts = [c.flags["dataset.episodes"] for c in cells if c.command is TRAIN]
    assert parts == ["0:500", "0:1000"]
    records = {c.name: played(0.2, 0.5) for c in cells if c.name.startswith("play-")}
    line = EXPERIMENTS["sample-efficiency"].report(config, records).lead[0]
    assert line == "Success with more data: 50.0 % (40k steps) to 50.0 % (80k steps) on wall."
    more = replace(config, data=replace(config.data, parts=(1.0, 2.0)))
    with pytest.raises(UsageError, match=r"give --data\.parts=\[1\.0\]"):
        EXPERIMENTS["sample-efficiency"].cells(more)
