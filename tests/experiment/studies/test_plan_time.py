"""Equal time: candidates follow from the time of few and of many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from egovcp.errors import EnvironmentFailure
from egovcp.plan import PlannerConfig, Policy
from egovcp.robot_spec import G1
from egovcp.testing import toy_model
from egovcp_experiment.cell import read_json
from egovcp_experiment.studies import plan_time


@pytest.mark.parametrize(
    ("few", "many", "budget", "samples"),
    [
        (10.0, 34.0, 40.0, 1216),  # 2 + M / 32 ms
        (10.0, 34.0, 34.0, 1024),
        (10.0, 34.0, 1.0, 32),  # out of reach: the least there is
    ],
)
def test_candidates_follow_from_two_times(
    few: float, many: float, budget: float, samples: int
) -> None:
    planner = PlannerConfig(samples=256, elites=4)
    found = plan_time._affordable(planner, "cem", few, many, budget)
    assert found["samples"] == samples
    assert found["elites"] == 4  # the planner's number
    assert found["plan_ms"] == pytest.approx(2 + samples / 32)
    assert found["within_budget"] == (budget > 3)


def test_times_that_do_not_grow_are_refused() -> None:
    with pytest.raises(EnvironmentFailure, match="timing too noisy"):
        plan_time._affordable(PlannerConfig(), "cem", 10.0, 10.0, 40.0)


def test_searches_of_another_robot_are_timed() -> None:
    robot = replace(G1, robot_type="arm", depth=(32, 48), depth_max_m=1.5)
    planner = PlannerConfig(samples=16, elites=4, iterations=1)
    times = plan_time._median_times({"cem": Policy(toy_model(robot=robot), planner, 1)}, rounds=1)
    assert times["cem"] > 0


def test_every_search_is_timed_and_can_be_played(
    flags: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measure = plan_time._median_times

    def times[K: tuple[str, int]](policies: Mapping[K, Policy], rounds: int) -> dict[K, float]:
        assert all(ms > 0 for ms in measure(policies, rounds).values())
        return {key: key[1] / 100 for key in policies}  # true times may not grow with the samples

    monkeypatch.setattr(plan_time, "_median_times", times)
    only = [f for f in flags if f.startswith(("--policy", "--output"))]
    planner = ["--planner.samples=256", "--planner.elites=20"]
    assert plan_time.main([*only, *planner, "--rounds=5", "--budget_ms=20"]) == 0
    found = read_json(tmp_path / "out" / "result.json")["searches"]
    assert set(found) == set(plan_time.SEARCHES)
    for row in found.values():
        assert row["elites"] == min(20, row["samples"] // 2)
        PlannerConfig(**{k: row[k] for k in ("optimiser", "iterations", "samples", "elites")})
