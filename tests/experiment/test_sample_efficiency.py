"""Figure 5: what is said of more data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from egovcp_experiment.config import DataConfig, ExperimentConfig, PpoConfig
from egovcp_experiment.experiments import EXPERIMENTS

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
