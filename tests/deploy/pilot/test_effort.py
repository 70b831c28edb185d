"""The planner weighs less while time is short, and as much as it may when it is not."""

from __future__ import annotations

import pytest

from egovcp.plan import PlannerConfig
from egovcp_deploy.pilot.effort import GOOD_TO_DOUBLE, POOR_TO_HALVE, Effort

FULL = PlannerConfig(samples=1024, elites=64, iterations=3)

#: Late, or cut short: (late, rounds).
POOR = [(True, 3), (False, 2), (False, 1), (True, 1)]


@pytest.mark.parametrize(("late", "rounds"), POOR)
def test_a_poor_plan_now_and_then_changes_nothing(late: bool, rounds: int) -> None:
    effort = Effort(FULL)
    for _ in range(50):
        effort.record(late, rounds)
        effort.record(late=False, iterations=3)
        effort.record(late=False, iterations=3)
    assert effort.config == FULL


@pytest.mark.parametrize(("late", "rounds"), POOR)
def test_every_second_plan_poor_is_too_often(late: bool, rounds: int) -> None:
    effort = Effort(FULL)
    for _ in range(10):
        effort.record(late, rounds)
        effort.record(late=False, iterations=3)
    assert effort.config.samples < 1024


@pytest.mark.parametrize(("late", "rounds"), POOR)
def test_three_poor_plans_in_a_row_halve_the_samples(late: bool, rounds: int) -> None:
    effort = Effort(FULL)
    changed = [effort.record(late, rounds) for _ in range(POOR_TO_HALVE)]
    assert changed == [False, False, True]
    assert (effort.config.samples, effort.config.elites) == (512, 32)
    assert effort.config.iterations == 3


def test_there_is_a_floor_and_a_way_back_to_the_full_number_but_not_beyond() -> None:
    effort = Effort(FULL)
    for _ in range(100):
        effort.record(late=True, iterations=1)
    assert effort.config.samples == 64
    assert effort.config.elites == 4
    for _ in range(10 * GOOD_TO_DOUBLE):
        effort.record(late=False, iterations=3)
    assert effort.config == FULL


def test_a_planner_that_is_small_already_is_left_alone() -> None:
    effort = Effort(PlannerConfig(samples=16, elites=4))
    assert not any(effort.record(late=True, iterations=1) for _ in range(20))
    assert effort.config.samples == 16


@pytest.mark.parametrize("elites", [1, 2, 4, 6])
def test_few_elites_are_not_halved(elites: int) -> None:
    effort = Effort(PlannerConfig(samples=256, elites=elites))
    for _ in range(POOR_TO_HALVE):
        effort.record(late=True, iterations=1)
    assert (effort.config.samples, effort.config.elites) == (128, min(elites, 4))
