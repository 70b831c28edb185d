"""The number of samples adapts to late and incomplete plans; the recurrence to missing ones."""

from __future__ import annotations

import numpy as np
import pytest

from egovcp.plan import PlannerConfig, PolicyStep
from egovcp.spec import ACTION_DIM, STATE_DIM
from egovcp_deploy.pilot.planner import (
    GOOD_TO_DOUBLE,
    POOR_TO_HALVE,
    AdaptiveBudget,
    ObservationMessage,
    PlannerRunner,
)

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
    assert budget.config.samples == 16
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


def test_the_default_planner_is_halved_down_to_16_samples() -> None:
    budget = AdaptiveBudget(PlannerConfig())
    samples = [budget.config.samples]
    for _ in range(10 * POOR_TO_HALVE):
        if budget.record(late=True, iterations=1):
            samples.append(budget.config.samples)
    assert samples == [64, 32, 16]
    assert budget.config.elites == 4


class Counted:
    """Counts restarts of the recurrence."""

    def __init__(self) -> None:
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1

    def act(self, depth: object, state: object, remaining: object = None) -> PolicyStep:
        plan = np.zeros((1, 4, ACTION_DIM), np.float32)
        return PolicyStep(plan[:, 0], plan, iterations=1)

    def observe(self, depth: object, state: object) -> None: ...

    def advance(self, sent: object) -> None: ...


def test_a_new_run_restarts_the_recurrence_without_lost_observations() -> None:
    policy = Counted()
    runner = PlannerRunner(policy)

    def plan(tick: int) -> tuple[str, ...]:
        depth, state = np.zeros((48, 64), np.uint16), np.zeros(STATE_DIM, np.float32)
        sent = np.zeros(ACTION_DIM)
        return runner.plan([ObservationMessage(tick, 0, depth, state, sent, tick == 0)]).events

    assert [plan(tick) for tick in (0, 1, 2, 0, 1)] == [()] * 5
    assert policy.resets == 2
    assert plan(4) == ("planner lost 2 observations: recurrence restarted",)
    assert policy.resets == 3
