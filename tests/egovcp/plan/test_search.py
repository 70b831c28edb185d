"""Action parameterizations and deadlines of the search."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.plan import Plan, PlannerConfig, Policy, ReferenceEvaluator, make_plan, optimiser_of
from egovcp.plan.config import OptimiserName
from egovcp.plan.objective import PlanValue
from egovcp.plan.search import Deadline, random_walk, reflect_once, target_steps
from tests.support.models import CountingModel
from tests.support.worlds import Point, PointWorld, plain_planner

ETA = spec.ACTION_ETA


def _uniform(*shape: int) -> Tensor:
    """In the box."""
    return 2 * torch.rand(shape, generator=torch.Generator().manual_seed(len(shape))) - 1


def test_the_walk_stays_in_the_box_and_steps_within_eta() -> None:
    start, deltas = _uniform(500, 7), _uniform(500, 6, 7)
    actions = random_walk(start, deltas, ETA)
    assert actions.abs().max() <= 1
    before = torch.cat([start[:, None], actions[:, :-1]], 1)
    assert (actions - before).abs().max() <= ETA + 1e-6


def test_the_walk_far_from_the_walls_is_a_sum() -> None:
    deltas = torch.full((1, 3, 7), 0.5)
    steps = torch.arange(1, 4)[None, :, None] * 0.5 * ETA
    torch.testing.assert_close(random_walk(torch.zeros(1, 7), deltas, ETA), steps.expand(1, 3, 7))


@pytest.mark.parametrize(("x", "inside"), [(1.2, 0.8), (-1.3, -0.7), (0.4, 0.4), (1.0, 1.0)])
def test_reflection_folds_at_the_walls(x: float, inside: float) -> None:
    assert reflect_once(torch.tensor(x)).item() == pytest.approx(inside)


# --- ramps --------------------------------------------------------------------------------
@pytest.mark.parametrize("eta", [ETA, 0.05, 2.0])
def test_a_ramp_goes_straight_to_one_place_and_rests_there(eta: float) -> None:
    start, deltas = _uniform(500, 7), _uniform(500, 6, 7)
    steps = target_steps(start, deltas, eta)
    actions = random_walk(start, steps, eta)
    assert actions.abs().max() <= 1 + 1e-6
    place = reflect_once((start + eta * deltas.sum(1)).clamp(-3, 3))
    left = torch.cat([(place - start)[:, None], place[:, None] - actions], 1)  # (500, 7, 7)
    torch.testing.assert_close(
        left[:, 1:].abs(), (left[:, :-1].abs() - eta).clamp_min(0.0), atol=1e-5, rtol=0
    )
    assert (left[:, :-1] * left[:, 1:] >= -1e-5).all()  # never past it


def test_a_ramp_is_a_ramp_of_itself() -> None:
    start = _uniform(500, 7)
    steps = target_steps(start, _uniform(500, 4, 7), ETA)
    torch.testing.assert_close(target_steps(start, steps, ETA), steps, atol=1e-5, rtol=0)


def _plan(config: PlannerConfig, goal: Tensor) -> Plan:
    world, executed = PointWorld(), torch.zeros_like(goal)
    evaluator, generator = ReferenceEvaluator(world, config), torch.Generator().manual_seed(0)
    carry = world.start(executed, goal)
    return make_plan(evaluator, optimiser_of(config), carry, executed, config, generator)


@pytest.mark.parametrize("optimiser", ["cem", "icem", "mppi", "shooting"])
def test_every_search_evaluates_target_steps(optimiser: OptimiserName) -> None:
    config = PlannerConfig(
        samples=64, elites=8, optimiser=optimiser, action_parameterization="target"
    )
    candidates = _plan(config, _uniform(16, 7)).candidates  # (16, 8, 4, 7), from 0
    steps = torch.diff(candidates, dim=2, prepend=torch.zeros(16, 8, 1, 7)) / ETA
    torch.testing.assert_close(target_steps(torch.zeros(7), steps, ETA), steps, atol=1e-5, rtol=0)


@pytest.mark.parametrize("reach", [0.2, 0.9])
def test_the_first_action_of_a_ramp_is_found_with_fewer_candidates(reach: float) -> None:
    """The best first action is known: as far towards the goal as a tick allows."""
    goal, missed = reach * _uniform(64, 7), {}
    for process in ("random_walk", "target"):
        plan = _plan(PlannerConfig(samples=64, elites=4, action_parameterization=process), goal)
        missed[process] = float((plan.actions[:, 0] - goal.clamp(-ETA, ETA)).abs().mean())
    assert missed["target"] < 0.6 * missed["random_walk"]


CONFIG = plain_planner(samples=64, elites=8, iterations=6)


class _Clock:
    """Seconds left, set by the test."""

    def __init__(self, left: float) -> None:
        self.left = left

    def __call__(self) -> float:
        return self.left


class _Slow:
    """An evaluator whose n-th evaluation takes ``costs[n]`` seconds of a clock."""

    def __init__(self, clock: _Clock, costs: list[float]) -> None:
        self._clock, self._costs = clock, iter(costs)

    def at(self, carry: Point) -> PlanValue:
        plan_value = ReferenceEvaluator(PointWorld(), CONFIG).at(carry)

        def slow(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            self._clock.left -= next(self._costs)
            return plan_value(actions, generator)

        return slow


def _timed_plan(left: float, costs: list[float]) -> Plan:
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
    assert _timed_plan(left, costs).iterations == iterations


def test_a_search_cut_short_answers_as_a_shorter_one() -> None:
    cut = _timed_plan(2.5, [1.0] * 6)
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


def test_a_policy_passes_its_deadline_on_and_reports_iterations() -> None:
    policy = Policy(CountingModel(), CONFIG, num_envs=1)
    depth = np.full((1, spec.DEPTH_ROWS, spec.DEPTH_COLS), 1000, np.uint16)
    state = np.zeros((1, spec.STATE_DIM), np.float32)
    assert policy.act(depth, state).iterations == CONFIG.iterations
    assert policy.act(depth, state, lambda: -1.0).iterations == 1
    assert policy.act(depth, state, lambda: 1e9).iterations == CONFIG.iterations
