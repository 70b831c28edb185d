"""Branches start where the plan was made, follow it, and part ways after it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.scenario import Scenario
from egovcp_experiment.studies.residuals import STEPS, _branches, _Point, main
from egovcp_experiment.tools import read_json


def _config(ticks: int) -> EnvConfig:
    quiet = EpisodeConfig(ticks=ticks, event_ticks=(3, 3), empty_probability=1.0)
    return replace(EnvConfig(controller="stance"), ball_episode=quiet)


def _branch(ticks: int, steps: int, plan: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    point = _Point(Scenario("ball", 0, 0), 2, [np.zeros(7)] * 2, {}, {})
    rng = np.random.default_rng(0)
    return _branches(_config(ticks), point, plan, 2, rng, 0.5, steps)


def test_each_step_counts_from_its_own_action_on() -> None:
    """In an empty scene the reward is the cost of the pose, -0.01 mean(a^2), known in advance."""
    plan = np.repeat(np.linspace(0.1, 0.3, STEPS)[:, None], 7, axis=1)
    short, whole = _branch(2 + STEPS, 1, plan)
    np.testing.assert_allclose(short, np.repeat(-0.01 * plan[:, :1] ** 2, 2, axis=1), rtol=1e-9)
    np.testing.assert_allclose(whole[-1], short[-1])  # the episode ends with the plan
    assert (whole[:-1] < short[:-1]).all()


def test_walks_part_after_the_plan() -> None:
    short, whole = _branch(20, 6, np.zeros((STEPS, 7)))
    assert (short[:, 0] != short[:, 1]).all()
    assert (np.abs(whole) >= np.abs(short)).all()


def test_the_study_measures_both_kinds_of_plans(flags: list[str], tmp_path: Path) -> None:
    few = [flag for flag in flags if not flag.startswith("--episodes")]
    assert main([*few, "--episodes=3", "--branches=2", "--task=ball"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert found["return_steps"] == 8
    for row in found["plans"].values():
        assert row["plans"] == 3
        assert [at["n"] for at in row["horizons"]] == list(range(1, STEPS + 1))
