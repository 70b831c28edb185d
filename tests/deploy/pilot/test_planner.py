"""The number of samples adapts to late and incomplete plans."""

from __future__ import annotations

import pytest

from egovcp.plan import PlannerConfig
from egovcp_deploy.pilot.planner import GOOD_TO_DOUBLE, POOR_TO_HALVE, AdaptiveBudget

FULL = PlannerConfig(samples=1024, elites=64, iterations=3)

#: Late, or cut short: (late, rounds).
POOR = [(True, 3), (False, 2), (False, 1), (True, 1)]


@pytest.mark.parametrize(("late", "rounds"), POOR)
def test_every_third_plan_poor_changes_nothing(late: bool, rounds: int) -> None:
    budget = AdaptiveBudget(FULL)
    for _ in range(50):
        budget.record(late, rounds)
        budget.record(late=False, iterations=3)
        budget.record(late=False, iterations=3)
    assert budget.config == FULL


@pytest.mark.parametrize(("late", "rounds"), POOR)
def test_every_second_plan_poor_reduces_the_samples(late: bool, rounds: int) -> None:
    budget = AdaptiveBudget(FULL)
    for _ in range(10):
        budget.record(late, rounds)
        budget.record(late=False, iterations=3)
    assert budget.config.samples < 1024


@pytest.mark.parametrize(("late", "rounds"), POOR)
def test_three_poor_plans_in_a_row_halve_the_samples(late: bool, rounds: int) -> None:
    budget = AdaptiveBudget(FULL)
    changed = [budget.record(late, rounds) for _ in range(POOR_TO_HALVE)]
    assert changed == [False, False, True]
    assert (budget.config.samples, budget.config.elites) == (512, 32)
    assert budget.config.iterations == 3


def test_samples_have_a_minimum_and_return_to_the_full_number() -> None:
    budget = AdaptiveBudget(FULL)
    for _ in range(100):
        budget.record(late=True, iterations=1)
    assert budget.config.samples == 64
    assert budget.config.elites == 4
    for _ in range(10 * GOOD_TO_DOUBLE):
        budget.record(late=False, iterations=3)
    assert budget.config == FULL


def test_a_small_planner_is_not_reduced() -> None:
    budget = AdaptiveBudget(PlannerConfig(samples=16, elites=4))
    assert not any(budget.record(late=True, iterations=1) for _ in range(20))
    assert budget.config.samples == 16


@pytest.mark.parametrize("elites", [1, 2, 4, 6])
def test_few_elites_are_not_halved(elites: int) -> None:
    budget = AdaptiveBudget(PlannerConfig(samples=256, elites=elites))
    for _ in range(POOR_TO_HALVE):
        budget.record(late=True, iterations=1)
    assert (budget.config.samples, budget.config.elites) == (128, min(elites, 4))
