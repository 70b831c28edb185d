"""Branches start where the plan was made, follow it, and part ways after it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from egovcp.sim.config import EnvConfig, EpisodeConfig
from egovcp.sim.policies import RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp_experiment.studies.residuals import STEPS, _branches, _Point, main
from egovcp_experiment.tools import read_json


def _config(ticks: int) -> EnvConfig:
    quiet = EpisodeConfig(ticks=ticks, event_ticks=(3, 3), empty_probability=1.0)
    return replace(EnvConfig(controller="stance"), ball_episode=quiet)


def _branch(
    ticks: int, steps: int, plan: np.ndarray, walk: RandomWalk
) -> tuple[np.ndarray, np.ndarray]:
    point = _Point(Scenario("ball", 0, 0), 2, [np.zeros(7)] * 2, {}, {})
    rngs = np.random.default_rng(0).spawn(2 * STEPS)
    return _branches(_config(ticks), point, plan, walk, rngs, 0.5, steps)


def test_each_step_counts_from_its_own_action_on() -> None:
    """In an empty scene the reward is the cost of the pose, -0.01 mean(a^2), known in advance."""
    plan = np.repeat(np.linspace(0.1, 0.3, STEPS)[:, None], 7, axis=1)
    short, whole = _branch(2 + STEPS, 1, plan, RandomWalk())
    np.testing.assert_allclose(short, np.repeat(-0.01 * plan[:, :1] ** 2, 2, axis=1), rtol=1e-9)
    np.testing.assert_allclose(whole[-1], short[-1])  # the episode ends with the plan
    assert (whole[:-1] < short[:-1]).all()


def test_walks_part_after_the_plan() -> None:
    short, whole = _branch(20, 6, np.zeros((STEPS, 7)), RandomWalk())
    assert (short[:, 0] != short[:, 1]).all()
    assert (np.abs(whole) >= np.abs(short)).all()


def test_a_walk_that_rests_stays_where_the_plan_has_led() -> None:
    """A rest of 100 ticks is all but never over within the 6 ticks after the plan: what is counted
    is the cost of standing where the plan ended, -0.01 mean(a^2) in each tick."""
    plan = np.repeat(np.linspace(0.1, 0.3, STEPS)[:, None], 7, axis=1)
    resting = RandomWalk(step_ticks=(100, 100))
    short, _ = _branch(2 + STEPS + 6, 6, plan, resting)
    discounts = 0.5 ** np.arange(6)
    for k in range(STEPS):
        stood = -0.01 * plan[k, 0] ** 2 * discounts.sum()
        assert np.isclose(short[k], stood, rtol=1e-9).any()


def test_the_study_measures_both_kinds_of_plans(flags: list[str], tmp_path: Path) -> None:
    few = [flag for flag in flags if not flag.startswith("--episodes")]
    walk = ["--eta=1", "--step_ticks=[5,15]"]
    assert main([*few, *walk, "--episodes=3", "--branches=2", "--task=ball"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert found["return_steps"] == 8
    for row in found["plans"].values():
        assert row["plans"] == 3
        assert [at["n"] for at in row["horizons"]] == list(range(1, STEPS + 1))
