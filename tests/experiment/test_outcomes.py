"""Paired differences say what they should."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp_experiment.outcomes import Outcome, outcome


def made(success: np.ndarray, reward: np.ndarray | None = None) -> Outcome:
    rewards = success if reward is None else reward
    return Outcome(rewards.astype(float), np.full(rewards.shape, 10.0), success.astype(float))


def test_the_same_luck_on_the_same_scenarios_cancels() -> None:
    """Scenarios that differ tenfold more than the two do: apart paired, not apart unpaired."""
    rng = np.random.default_rng(0)
    luck = rng.normal(0.0, 1.0, (1, 100))
    ours, theirs = made(luck > 9, luck + 0.1), made(luck > 9, luck)
    gain, (low, high) = ours.reward_gain(theirs)
    assert gain == pytest.approx(0.01)
    assert 0.009 < low <= high < 0.011
    assert ours.reward_interval[0] < theirs.reward_per_step


def test_no_difference_is_zero_and_a_real_one_is_found() -> None:
    rng = np.random.default_rng(1)
    ours = made(rng.random((3, 100)) < 0.6)
    assert ours.success_gain(ours) == (0.0, (0.0, 0.0))
    gain, (low, high) = ours.success_gain(made(np.zeros((3, 100))))
    assert low < gain < high
    assert low > 0.4


def test_rewards_of_wins_leave_out_what_either_has_lost() -> None:
    won = np.array([[1, 1, 0, 1], [1, 0, 0, 1]])
    lost = np.array([[1, 1, 1, 0], [0, 1, 1, 0]])
    ours = made(won, np.where(won, 3.0, -50.0))
    theirs = made(lost, np.where(lost, 1.0, 70.0))
    found = ours.reward_gain_of_wins(theirs)  # seed 0 both win scenarios 0 and 1, seed 1 none
    assert found is not None
    gain, interval = found
    assert gain == pytest.approx(0.2)
    assert interval == pytest.approx((0.2, 0.2))
    assert ours.reward_gain_of_wins(made(1 - won)) is None


def test_paired_intervals_cover_about_as_often_as_they_say() -> None:
    rng = np.random.default_rng(2)
    covered = 0
    for _ in range(60):
        scenario = rng.normal(0, 1, (1, 80))
        ours = scenario + rng.normal(0.3, 0.5, (2, 80))
        low, high = made(ours > 0, ours).reward_gain(made(scenario > 0, scenario))[1]
        covered += low <= 0.03 <= high
    assert 50 <= covered <= 60


def test_parts_of_a_sequence_have_rates_of_their_own() -> None:
    def record(ball: list[bool]) -> dict[str, object]:
        parts = {"arch": [True, True], "ball": ball}
        played = {"episode": [0, 1], "steps": [5, 5], "reward": [1.0, 2.0], "success": ball}
        row = {"played": {**played, "parts": parts}, "plan_ms_p50": 3.0}
        return {"figures": {"sequence": {"planner": row}}}

    records = {"a": record([True, False]), "b": record([False, False])}
    found = outcome(records, ["a", "b"], "sequence")
    assert found is not None
    assert found.part_rates == found.figures()["parts"] == {"arch": 1.0, "ball": 0.25}
    assert "parts" not in made(np.ones((1, 4))).figures()


def test_seeds_that_are_not_there_are_left_out() -> None:
    played = {"episode": [0, 1], "steps": [5, 5], "reward": [1.0, 2.0], "success": [True, False]}
    record = {"figures": {"ball": {"planner": {"played": played, "plan_ms_p50": 3.0}}}}
    found = outcome({"a": record}, ["a", "b"], "ball")
    assert found is not None
    assert (found.success_rate, found.reward_per_step) == (0.5, 0.3)
    assert found.reward_spread is None
    assert outcome({}, ["a"], "ball") is None
