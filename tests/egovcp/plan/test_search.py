"""Action parameterizations and deadlines of the search."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.model import PRESETS
from egovcp.plan import Plan, PlannerConfig, Policy, ReferenceEvaluator, make_plan, optimiser_of
from egovcp.plan.backends import make_evaluator
from egovcp.plan.config import BackendName, Objective, OptimiserName
from egovcp.plan.objective import PlanValue
from egovcp.plan.search import action_costs, random_walk, reflect_once, target_deltas
from egovcp.testing import toy_model
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


def test_walk_far_from_the_bounds_is_a_sum() -> None:
    deltas = torch.full((1, 3, 7), 0.5)
    steps = torch.arange(1, 4)[None, :, None] * 0.5 * ETA
    torch.testing.assert_close(random_walk(torch.zeros(1, 7), deltas, ETA), steps.expand(1, 3, 7))


@pytest.mark.parametrize(("x", "inside"), [(1.2, 0.8), (-1.3, -0.7), (0.4, 0.4), (1.0, 1.0)])
def test_reflection_at_the_bounds(x: float, inside: float) -> None:
    assert reflect_once(torch.tensor(x)).item() == pytest.approx(inside)


# --- targets ------------------------------------------------------------------------------
@pytest.mark.parametrize("eta", [ETA, 0.05, 2.0])
def test_target_deltas_move_straight_to_one_target_and_hold(eta: float) -> None:
    start, deltas = _uniform(500, 7), _uniform(500, 6, 7)
    steps = target_deltas(start, deltas, eta)
    actions = random_walk(start, steps, eta)
    assert actions.abs().max() <= 1 + 1e-6
    place = reflect_once((start + eta * deltas.sum(1)).clamp(-3, 3))
    left = torch.cat([(place - start)[:, None], place[:, None] - actions], 1)  # (500, 7, 7)
    torch.testing.assert_close(
        left[:, 1:].abs(), (left[:, :-1].abs() - eta).clamp_min(0.0), atol=1e-5, rtol=0
    )
    assert (left[:, :-1] * left[:, 1:] >= -1e-5).all()  # never past it


def test_target_deltas_are_idempotent() -> None:
    start = _uniform(500, 7)
    steps = target_deltas(start, _uniform(500, 4, 7), ETA)
    torch.testing.assert_close(target_deltas(start, steps, ETA), steps, atol=1e-5, rtol=0)


def _plan(config: PlannerConfig, goal: Tensor) -> Plan:
    world, executed = PointWorld(), torch.zeros_like(goal)
    evaluator, generator = ReferenceEvaluator(world, config), torch.Generator().manual_seed(0)
    carry = world.start(executed, goal)
    return make_plan(evaluator, optimiser_of(config), carry, executed, config, generator)


@pytest.mark.parametrize("optimiser", ["cem", "icem", "mppi", "shooting"])
def test_every_search_evaluates_target_deltas(optimiser: OptimiserName) -> None:
    config = PlannerConfig(
        samples=64, elites=8, optimiser=optimiser, action_parameterization="target"
    )
    candidates = _plan(config, _uniform(16, 7)).candidates  # (16, 8, 4, 7), from 0
    steps = torch.diff(candidates, dim=2, prepend=torch.zeros(16, 8, 1, 7)) / ETA
    torch.testing.assert_close(target_deltas(torch.zeros(7), steps, ETA), steps, atol=1e-5, rtol=0)


@pytest.mark.parametrize("reach", [0.2, 0.9])
def test_first_action_towards_a_target_needs_fewer_candidates(reach: float) -> None:
    """The best first action is known: as far towards the goal as one step allows."""
    goal, missed = reach * _uniform(64, 7), {}
    for process in ("random_walk", "target"):
        plan = _plan(PlannerConfig(samples=64, elites=4, action_parameterization=process), goal)
        missed[process] = float((plan.actions[:, 0] - goal.clamp(-ETA, ETA)).abs().mean())
    assert missed["target"] < 0.6 * missed["random_walk"]


@pytest.mark.parametrize("objective", ["value", "reward", "td"])
@pytest.mark.parametrize("optimiser", ["cem", "icem", "mppi", "shooting"])
@pytest.mark.parametrize("backend", ["eager", "auto"])
def test_value_of_a_plan_is_the_objective_less_the_discounted_action_costs(
    objective: Objective, optimiser: OptimiserName, backend: BackendName
) -> None:
    debug = PRESETS["debug"]
    model = toy_model(dataclasses.replace(debug, loss=dataclasses.replace(debug.loss, reward=1.0)))
    config = PlannerConfig(
        samples=16,
        objective=objective,
        optimiser=optimiser,
        backend=backend,
        pose_cost=3.0,
        action_rate_cost=2.0,
    )
    evaluator, carry = make_evaluator(model, config), model.initial(2)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        start = _uniform(2, 7)
        plan = make_plan(evaluator, optimiser_of(config), carry, start, config, generator)
        values = evaluator.at(carry)(plan.candidates, None)

    def cost(before: np.ndarray, actions: np.ndarray) -> float:
        total = 0.0
        for k in range(4 if objective == "reward" else 16):
            action = actions[min(k, len(actions) - 1)]  # the last one is held
            change = (action - before) / spec.ACTION_RATE_LIMIT
            total += spec.GAMMA**k * float(3.0 * np.mean(action**2) + 2.0 * np.mean(change**2))
            before = action
        return total

    robots = zip(start.numpy(), plan.candidates.numpy(), strict=True)
    costs = [[cost(before, actions) for actions in robot] for before, robot in robots]
    torch.testing.assert_close(
        plan.candidate_values, values - torch.tensor(costs), rtol=0, atol=1e-4
    )


def test_costs_are_discounted_with_the_given_factor() -> None:
    config = PlannerConfig(horizon=1, pose_cost=1.0, action_rate_cost=0.0)
    start, held = torch.ones(1, 1, 7), torch.ones(1, 1, 1, 7)
    cost = action_costs(start, held, config, torch.tensor(0.5))
    assert float(cost) == pytest.approx(sum(0.5**k for k in range(spec.RETURN_STEPS)))


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
def test_no_iteration_starts_that_would_end_too_late(
    left: float, costs: list[float], iterations: int
) -> None:
    assert _timed_plan(left, costs).iterations == iterations


def test_interrupted_search_equals_one_with_fewer_iterations() -> None:
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


def test_a_policy_passes_its_deadline_on_and_reports_iterations() -> None:
    policy = Policy(CountingModel(), CONFIG, num_envs=1)
    depth = np.full((1, spec.DEPTH_ROWS, spec.DEPTH_COLS), 1000, np.uint16)
    state = np.zeros((1, spec.STATE_DIM), np.float32)
    assert policy.act(depth, state).iterations == CONFIG.iterations
    assert policy.act(depth, state, lambda: -1.0).iterations == 1
    assert policy.act(depth, state, lambda: 1e9).iterations == CONFIG.iterations
