"""Statistics of episodes and their tables."""

from __future__ import annotations

from dataclasses import replace

import pytest

from egovcp_deploy.scores import (
    EpisodeScore,
    eval_scores,
    paired,
    summarise,
    summary,
    table,
)


def score(episode: int, success: bool, reward: float = 0.0, steps: int = 10) -> EpisodeScore:
    return EpisodeScore(episode, steps, reward, success, False, [1.0 + episode])


def test_reward_per_step_weighs_episodes_by_their_length() -> None:
    scores = [score(0, True, 1.0, steps=10), score(1, False, 0.0, steps=90)]
    assert eval_scores(scores).reward_per_step == pytest.approx(0.01)


def test_the_gain_is_paired_by_scenario() -> None:
    ours = [score(i, i % 2 == 0) for i in range(40)]
    a, b = map(eval_scores, paired(ours, list(reversed(ours))))
    low, high = a.gain(b).success_interval
    assert -low == high < 0.05
    worse = [score(i, False) for i in range(40)]
    low, high = eval_scores(ours).gain(eval_scores(worse)).success_interval
    assert 0.3 < low < 0.5 < high < 0.7


def test_figures_have_the_documented_keys() -> None:
    figures = summarise([score(0, True, 1.0), score(1, False, -1.0)])
    assert list(figures) == [
        "episodes",
        "success_rate",
        "success_ci95",
        "reward_mean",
        "reward_ci95",
        "plan_ms_p50",
        "plan_ms_p99",
    ]
    assert figures["plan_ms_p50"] == 1.5


def test_the_table_has_one_aligned_line_per_controller() -> None:
    played = {"ball": {"planner": [score(0, True)], "hold": [score(0, False)]}}
    lines = table(summary(played, 1)).splitlines()
    assert len(lines) == 3
    assert lines[1].split()[:3] == ["ball", "planner", "100.0%"]
    assert len({len(line) for line in lines}) == 1


def test_parts_of_a_sequence_have_success_rates() -> None:
    won = [replace(score(i, i > 1), parts={"arch": i > 0, "ball": i > 1}) for i in range(4)]
    figures = summary({"sequence": {"hold": won}}, 4)
    parts = figures["sequence"]["hold"]["parts"]
    assert {name: part["success_rate"] for name, part in parts.items()} == {
        "arch": 0.75,
        "ball": 0.5,
    }
    assert parts["arch"]["success_ci95"][0] < 0.75 < parts["arch"]["success_ci95"][1]
    lines = [line.split()[:3] for line in table(figures).splitlines()]
    assert lines[1:] == [
        ["sequence", "hold", "50.0%"],
        ["-", "arch", "75.0%"],
        ["-", "ball", "50.0%"],
    ]
