"""Scores of several seeds and their paired differences."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp.eval_scores import EvalScores
from egovcp_experiment.results import eval_scores


def made(success: np.ndarray, reward: np.ndarray | None = None) -> EvalScores:
    rewards = success if reward is None else reward
    return EvalScores(rewards.astype(float), np.full(rewards.shape, 10.0), success.astype(float))


def test_paired_intervals_exclude_scenario_noise() -> None:
    """The std over scenarios is ten times the difference of the controllers."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0.0, 1.0, (1, 100))
    ours, theirs = made(noise > 9, noise + 0.1), made(noise > 9, noise)
    gain = ours.gain(theirs)
    low, high = gain.reward_interval
    assert gain.reward == pytest.approx(0.01)
    assert 0.009 < low <= high < 0.011
    assert ours.reward_interval[0] < theirs.reward_per_step


def test_differences_of_success() -> None:
    rng = np.random.default_rng(1)
    ours = made(rng.random((3, 100)) < 0.6)
    assert ours.gain(ours)[:3] == (0.0, (0.0, 0.0), 0.0)
    assert ours.gain(ours).success_interval == pytest.approx((-0.0192, 0.0192), abs=1e-4)
    gain = ours.gain(made(np.zeros((3, 100))))
    low, high = gain.success_interval
    assert low < gain.success < high
    assert low > 0.4


def test_paired_intervals_have_their_coverage() -> None:
    rng = np.random.default_rng(2)
    covered = 0
    for _ in range(60):
        scenario = rng.normal(0, 1, (1, 80))
        ours = scenario + rng.normal(0.3, 0.5, (2, 80))
        low, high = made(ours > 0, ours).gain(made(scenario > 0, scenario)).reward_interval
        covered += low <= 0.03 <= high
    assert 50 <= covered <= 60


def test_parts_of_a_sequence_have_rates() -> None:
    def record(ball: list[bool]) -> dict[str, object]:
        parts = {"arch": [True, True], "ball": ball}
        played = {"episode": [0, 1], "steps": [5, 5], "reward": [1.0, 2.0], "success": ball}
        row = {"played": {**played, "parts": parts}, "plan_ms_p50": 3.0}
        return {"metrics": {"sequence": {"planner": row}}}

    records = {"a": record([True, False]), "b": record([False, False])}
    found = eval_scores(records, ["a", "b"], "sequence")
    assert found is not None
    assert found.part_rates == found.figures()["parts"] == {"arch": 1.0, "ball": 0.25}
    assert "parts" not in made(np.ones((1, 4))).figures()


def test_missing_seeds_are_left_out() -> None:
    played = {"episode": [0, 1], "steps": [5, 5], "reward": [1.0, 2.0], "success": [True, False]}
    record = {"metrics": {"ball": {"planner": {"played": played, "plan_ms_p50": 3.0}}}}
    found = eval_scores({"a": record}, ["a", "b"], "ball")
    assert found is not None
    assert (found.success_rate, found.reward_per_step) == (0.5, 0.3)
    assert found.reward_spread is None
    assert eval_scores({}, ["a"], "ball") is None
