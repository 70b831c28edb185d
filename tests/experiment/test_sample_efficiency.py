"""Figure 5: what is said of more data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from egovcp_experiment.config import DataConfig, ExperimentConfig, PpoConfig
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.report.document import Table

COUNT = 40
CONFIG = ExperimentConfig(
    tasks=("wall",), data=DataConfig(parts=(0.5, 1.0)), ppo=PpoConfig(steps=0)
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
    [(0.3, "more data helps"), (0.1, "more data hurts"), (0.2, "no clear difference")],
)
def test_more_data_is_judged_by_reward_and_success_is_said_beside(
    reward: float, words: str
) -> None:
    half, whole = [
        cell.name
        for cell in EXPERIMENTS["sample-efficiency"].cells(CONFIG)
        if cell.name.startswith("play-")
    ]
    records = {half: played(0.2, 0.9), whole: played(reward, 0.7)}
    (line,) = EXPERIMENTS["sample-efficiency"].report(CONFIG, records).shows
    assert line.startswith("wall: 90.0% success from 100k steps, 70.0% from 200k steps: " + words)
    assert f"reward per step {reward - 0.2:+.5f}, 95 % " in line
    assert "success -20.0 points, " in line


def test_models_of_each_part_stand_beside_each_other(
    trained: Callable[[str, float], Mapping[str, Any]],
) -> None:
    cells = [cell.name for cell in EXPERIMENTS["sample-efficiency"].cells(CONFIG)]
    half, whole = [name for name in cells if name.startswith("train-")]
    records = {name: played(0.2, 0.9) for name in cells if name.startswith("play-")}
    records |= {half: trained("wall", 0.3), whole: trained("wall", 0.5)}
    found = EXPERIMENTS["sample-efficiency"].report(CONFIG, records)
    (table,) = [p for p in found.parts if isinstance(p, Table) and "held-out" in p.title]
    rows = [dict(zip(table.head, row, strict=True)) for row in table.rows]
    assert [(row["model"], row["Q R2"]) for row in rows] == [
        ("100k steps", "0.3"),
        ("200k steps", "0.5"),
    ]
