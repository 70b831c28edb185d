"""The planner thinks less while it is late, and as much as it may when it is not."""

from __future__ import annotations

from egovcp.plan import PlannerConfig
from egovcp_deploy.pilot.effort import IN_TIME_TO_DOUBLE, LATE_TO_HALVE, Effort


def test_a_plan_that_is_late_now_and_then_changes_nothing() -> None:
    effort = Effort(PlannerConfig(samples=1024, elites=64))
    for _ in range(50):
        effort.record(late=True)
        effort.record(late=False)
        effort.record(late=False)
    assert effort.config.samples == 1024


def test_every_second_plan_late_is_too_often() -> None:
    effort = Effort(PlannerConfig(samples=1024, elites=64))
    changed = [effort.record(late=k % 2 == 0) for k in range(20)]
    assert any(changed)
    assert effort.config.samples < 1024


def test_three_late_plans_in_a_row_halve_the_samples() -> None:
    effort = Effort(PlannerConfig(samples=1024, elites=64))
    changed = [effort.record(late=True) for _ in range(LATE_TO_HALVE)]
    assert changed == [False, False, True]
    assert (effort.config.samples, effort.config.elites) == (512, 32)


def test_there_is_a_floor_and_a_way_back_to_the_full_number_but_not_beyond() -> None:
    full = PlannerConfig(samples=1024, elites=64)
    effort = Effort(full)
    for _ in range(100):
        effort.record(late=True)
    assert effort.config.samples == 64
    assert effort.config.elites == 4
    for _ in range(10 * IN_TIME_TO_DOUBLE):
        effort.record(late=False)
    assert effort.config == full


def test_a_planner_that_is_small_already_is_left_alone() -> None:
    effort = Effort(PlannerConfig(samples=16, elites=4))
    assert not any(effort.record(late=True) for _ in range(20))
    assert effort.config.samples == 16
