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
from egovcp_experiment.cell import TRAIN, CellOutput
from egovcp_experiment.config import (
    SCALES,
    DataConfig,
    ExperimentConfig,
    PpoBaselineConfig,
    TrainingConfig,
)
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.experiments.sample_efficiency import SAVE_FREQ
from egovcp_train.config import TrainConfig

SCALING = EXPERIMENTS["sample-efficiency"]
COUNT = 40
DURING = ["play-wall-step_1000-s0", "play-wall-step_2000-s0"]
CONFIG = ExperimentConfig(
    tasks=("wall",),
    data=DataConfig(parts=(0.5, 1.0)),
    train=TrainingConfig(seeds=(0,)),
    ppo=PpoBaselineConfig(steps=0),
)


def plays(config: ExperimentConfig) -> list[str]:
    """Names of the evaluations of the planner."""
    return [cell.name for cell in SCALING.cells(config) if cell.name.startswith("play-")]


def played(reward: float, success: float) -> Mapping[str, Any]:
    """Ten ticks an episode."""
    rng = np.random.default_rng(0)
    result = {
        "episode": list(range(COUNT)),
        "steps": [10] * COUNT,
        "reward": (10 * reward + rng.normal(0, 0.1, COUNT)).tolist(),
        "success": [k < success * COUNT for k in range(COUNT)],
    }
    return {"metrics": {"wall": {"planner": {"played": result, "plan_ms_p50": 1.0}}}}


@pytest.mark.parametrize(
    ("reward", "words"),
    [(0.3, "better"), (0.1, "worse"), (0.2, "no different beyond chance")],
)
def test_more_data_is_judged_by_reward(reward: float, words: str) -> None:
    cells = plays(CONFIG)
    assert cells == ["play-wall-part_0.5-s0", "play-wall-default-s0", *DURING]
    records = {cells[0]: played(0.2, 0.9), cells[1]: played(reward, 0.7)}
    assert SCALING.report(CONFIG, records).lead[:2] == [
        "Success with more data: 90.0 % (200k transitions) to 70.0 % (400k transitions) on wall.",
        f"By reward, the model with most data is {words} on wall than the first.",
    ]


def test_the_default_model_is_played_as_it_was_during_its_training() -> None:
    assert TrainConfig(output_dir="out").save_freq == SAVE_FREQ
    cells = {cell.name: cell for cell in SCALING.cells(CONFIG)}
    path = "checkpoints/001000/pretrained_model"
    assert cells[DURING[0]].flags["policy.path"] == CellOutput("train-wall-default-s0", path)
    records = {name: played(0.1 * k, 0.2 * k) for k, name in enumerate(DURING, 1)}
    records["play-wall-default-s0"] = played(0.5, 0.8)
    page = SCALING.report(CONFIG, records)
    assert page.lead[1:] == [
        "Success with more gradient steps: 20.0 % (1000 steps) to 80.0 % (3000 steps) on wall.",
        "By reward, the model with most gradient steps is better on wall than the first.",
    ]
    assert page.plot is not None
    assert "gradient steps" in page.plot.svg
    given = replace(CONFIG, train=TrainingConfig(seeds=(0,), policies={"wall": "a/wall"}))
    assert not [name for name in plays(given) if "step_" in name]
    paper = SCALING.cells(replace(SCALES["paper"](), tasks=("wall",)))
    during = [cell.name for cell in paper if "step_" in cell.name and cell.name.endswith("s0")]
    assert during == [f"play-wall-step_{n}-s0" for n in (25_000, 50_000, 75_000)]
    flags = ("--save_freq=2000",)
    rare = replace(CONFIG, train=TrainingConfig(seeds=(0,), flags=flags))
    assert [name for name in plays(rare) if "step_" in name] == ["play-wall-step_2000-s0"]


@pytest.mark.parametrize(
    ("seeds", "steps", "words"),
    [((0,), 64, "of 1 training. "), ((0, 1), 64, "of 2 trainings. "), ((0, 1), 0, "one task.")],
)
def test_ppo_is_described_if_it_is_trained(seeds: tuple[int, ...], steps: int, words: str) -> None:
    ppo, train = PpoBaselineConfig(steps=steps), TrainingConfig(seeds=seeds)
    config = replace(CONFIG, ppo=ppo, train=train)
    introduction = str(SCALING.report(config, {}).sections[0])
    assert words in introduction
    assert ("PPO" in introduction) == bool(steps)


def test_parts_are_prefixes_of_one_dataset() -> None:
    data = DataConfig(parts=(2.0, 0.5))
    config = ExperimentConfig(tasks=("ball",), data=data, train=TrainingConfig(seeds=(0,)))
    cells = {c.name: c for c in SCALING.cells(config)}
    assert cells["collect-ball-10800"].flags["episodes"] == 10800
    parts = [c.flags["dataset.episodes"] for c in cells.values() if c.command is TRAIN]
    assert parts == ["0:2700", "0:10800"]


def test_a_given_policy_is_not_the_model_of_all_episodes() -> None:
    training = TrainingConfig(seeds=(0,), policies={"all": "a/all"})
    config = ExperimentConfig(tasks=("ball", "wall"), data=DataConfig(parts=(1.0,)), train=training)
    cells = SCALING.cells(config)
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
    cells = SCALING.cells(config)
    parts = [c.flags["dataset.episodes"] for c in cells if c.command is TRAIN]
    assert parts == ["0:500", "0:1000"]
    records = {c.name: played(0.2, 0.5) for c in cells if c.name.startswith("play-")}
    line = SCALING.report(config, records).lead[0]
    rates = "50.0 % (40k transitions) to 50.0 % (80k transitions)"
    assert line == f"Success with more data: {rates} on wall."
    more = replace(config, data=replace(config.data, parts=(1.0, 2.0)))
    for config in (more, replace(more, data=replace(more.data, parts=(2.0,)))):
        with pytest.raises(UsageError, match=r"give --data\.parts=\[1\.0\]"):
            SCALING.cells(config)
