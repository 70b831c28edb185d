from __future__ import annotations

import numpy as np
import pytest

from egovcp.errors import UsageError
from egovcp.sim.scenario import Scenario
from egovcp.spec import TASKS


def draw(scenario: Scenario, name: str) -> list[float]:
    return scenario.rng(name).random(4).tolist()


def test_equal_scenarios_draw_equal_numbers() -> None:
    assert draw(Scenario("ball", 3, 5), "x") == draw(Scenario("ball", 3, 5), "x")


@pytest.mark.parametrize(
    "other", [Scenario("wall", 3, 5), Scenario("ball", 4, 5), Scenario("ball", 3, 6)]
)
def test_any_other_scenario_draws_other_numbers(other: Scenario) -> None:
    assert not np.isin(draw(other, "x"), draw(Scenario("ball", 3, 5), "x")).any()


def test_scenarios_that_data_and_results_exist_of_draw_what_they_always_drew() -> None:
    drawn = [Scenario(task, 3, 5).rng("geometry").integers(10**6) for task in TASKS]
    assert drawn == [752199, 214740, 172848]


def test_streams_of_different_names_differ() -> None:
    scenario = Scenario("ball", 3, 5)
    assert not np.isin(draw(scenario, "x"), draw(scenario, "y")).any()


def test_unknown_task_is_told_with_the_near_name() -> None:
    with pytest.raises(UsageError, match="did you mean 'ball'"):
        Scenario("bal", 0, 0)


def test_negative_numbers_are_refused() -> None:
    with pytest.raises(UsageError, match="count from 0"):
        Scenario("ball", -1, 0)
