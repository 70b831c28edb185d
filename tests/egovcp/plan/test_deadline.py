"""A search that must answer in time does, with the best that it has."""

import numpy as np
import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.plan import Plan, Policy, ReferenceEvaluator, make_plan, optimiser_of
from egovcp.plan.objective import PlanValue
from egovcp.plan.search import Deadline
from tests.support.models import CountingModel
from tests.support.worlds import Point, PointWorld, plain_planner

CONFIG = plain_planner(samples=64, elites=8, iterations=6)


class _Clock:
    """Counts down only when told to."""

    def __init__(self, left: float) -> None:
        self.left = left

    def __call__(self) -> float:
        return self.left


class _Slow:
    """A evaluator whose n-th answer takes ``costs[n]`` seconds of a clock."""

    def __init__(self, clock: _Clock, costs: list[float]) -> None:
        self._clock, self._costs = clock, iter(costs)

    def at(self, carry: Point) -> PlanValue:
        plan_value = ReferenceEvaluator(PointWorld(), CONFIG).at(carry)

        def slow(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            self._clock.left -= next(self._costs)
            return plan_value(actions, generator)

        return slow


def _plan(left: float, costs: list[float]) -> Plan:
    clock, executed = _Clock(left), torch.zeros(1, 7)
    carry = Point(executed, torch.full((1, 7), 0.3))
    generator = torch.Generator().manual_seed(0)
    search = optimiser_of(CONFIG)
    return make_plan(
        _Slow(clock, costs), search, carry, executed, CONFIG, generator, remaining=clock
    )


@pytest.mark.parametrize(
    ("left", "costs", "iterations"),
    [
        (100.0, [1.0] * 6, 6),
        (3.5, [1.0] * 6, 3),
        (0.0, [1.0], 1),  # one is always made
        (-5.0, [1.0], 1),
        (10.0, [4.0, 1.0, 1.0, 1.0], 3),  # the slowest so far would no longer fit into 4
        (10.0, [1.0, 1.0, 5.0], 3),
    ],
)
def test_no_iteration_is_begun_that_would_end_too_late(
    left: float, costs: list[float], iterations: int
) -> None:
    assert _plan(left, costs).iterations == iterations


def test_a_search_cut_short_answers_as_a_shorter_one() -> None:
    cut = _plan(2.5, [1.0] * 6)
    executed = torch.zeros(1, 7)
    config = plain_planner(samples=64, elites=8, iterations=cut.iterations)
    whole = make_plan(
        ReferenceEvaluator(PointWorld(), config),
        optimiser_of(config),
        Point(executed, torch.full((1, 7), 0.3)),
        executed,
        config,
        torch.Generator().manual_seed(0),
    )
    assert cut.iterations == 2
    assert torch.equal(cut.actions, whole.actions)
    assert torch.equal(cut.value, whole.value)


def test_without_a_deadline_it_goes_on() -> None:
    pace = Deadline(None)
    assert all(pace.allows_iteration() for _ in range(100))


def test_a_policy_hands_its_deadline_on_and_reports_what_was_done() -> None:
    policy = Policy(CountingModel(), CONFIG, num_envs=1)
    depth = np.full((1, spec.DEPTH_ROWS, spec.DEPTH_COLS), 1000, np.uint16)
    state = np.zeros((1, spec.STATE_DIM), np.float32)
    assert policy.act(depth, state).iterations == CONFIG.iterations
    assert policy.act(depth, state, lambda: -1.0).iterations == 1
    assert policy.act(depth, state, lambda: 1e9).iterations == CONFIG.iterations
