"""Objectives of plans and termination rules."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.model import PRESETS, Carry, WorldModel
from egovcp.plan import PlannerConfig, Policy, ReferenceEvaluator, make_plan, optimiser_of
from egovcp.plan.backends import make_evaluator
from egovcp.plan.config import require_compatible
from egovcp.plan.objective import evaluate
from egovcp.testing import toy_model
from tests.support.worlds import Point, PointWorld, ScriptedWorld, plain_planner

OBJECTIVES = ("value", "reward", "td")
RULES = ("paper", "shift", "survival")
DEBUG = PRESETS["debug"]
EARNING = dataclasses.replace(DEBUG, loss=dataclasses.replace(DEBUG.loss, reward=1.0))
REWARDS, VALUES = [1.0, 2.0, 4.0, 8.0], [5.0, 6.0, 7.0, 9.0]
MIXED_VALUES = [8.0, 4.0, -2.0, 6.0]
ALIVE = [0.0, 0.0, 0.0, 0.0]


def _value(
    deaths: list[float], horizon: int = 4, values: list[float] = VALUES, **config: Any
) -> float:
    """V of a plan in the scripted world, with gamma 0.5 and a smallest return of -10."""
    world = ScriptedWorld(values, deaths, -10.0, REWARDS, 0.5)
    planner = plain_planner(horizon=horizon, **config)
    actions = torch.zeros(1, 1, planner.actions, spec.ACTION_DIM)
    return evaluate(world, world.start(), actions, planner).item()


# --- by hand --------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("objective", "horizon", "expected"),
    [
        ("reward", 1, 1.0),
        ("reward", 3, 1.0 + 0.5 * 2.0 + 0.25 * 4.0),
        ("td", 1, 1.0 + 0.5 * 6.0),
        ("td", 3, 1.0 + 0.5 * 2.0 + 0.25 * 4.0 + 0.125 * 9.0),
    ],
)
def test_rewards_are_discounted_and_the_value_comes_after_the_last(
    objective: str, horizon: int, expected: float
) -> None:
    assert _value(ALIVE, horizon, objective=objective) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("paper", 1.0 + 0.5 * 2.0),
        ("shift", 1.0 + 0.5 * 2.0 + 0.25 * -10.0),
        ("survival", 1.0 + 0.5 * 2.0 + 0.25 * -10.0),
    ],
)
def test_a_failed_plan_has_the_value_of_failing_forever(rule: str, expected: float) -> None:
    """It fails at step 1, whose own reward counts; rewards and value after it do not."""
    found = _value([0.0, 1.0, 0.0, 0.0], 3, objective="td", termination_rule=rule)
    assert found == pytest.approx(expected)


def test_half_a_failure_costs_half_of_what_comes_next() -> None:
    found = _value([0.0, 0.5, 0.0, 0.0], 2, objective="td", termination_rule="survival")
    assert found == pytest.approx(1.0 + 0.5 * 2.0 + 0.25 * (0.5 * 7.0 + 0.5 * -10.0))


@pytest.mark.parametrize("rule", RULES)
def test_without_a_failure_the_objective_is_the_mean_value(rule: str) -> None:
    found = _value(ALIVE, values=MIXED_VALUES, termination_rule=rule)
    assert found == pytest.approx(sum(MIXED_VALUES) / 4)


@pytest.mark.parametrize(
    ("rule", "deaths", "expected"),
    [
        # The failed state's own value counts, later ones are lost.
        ("paper", [0, 0.95, 0, 0], (8 + 4 + 0 + 0) / 4),
        ("paper", [0, 0, 0.95, 0], (8 + 4 - 2 + 0) / 4),
        ("shift", [0, 0.95, 0, 0], (8 + 4 - 10 - 10) / 4),
        ("shift", [0, 0, 0.95, 0], (8 + 4 - 2 - 10) / 4),
        # Each value above the floor, weighted with the probability of being alive.
        ("survival", [0, 0.5, 0, 0], (8 + 4 + (0.5 * 8 - 10) + (0.5 * 16 - 10)) / 4),
        ("survival", [0, 0.5, 0.5, 0], (8 + 4 + (0.5 * 8 - 10) + (0.25 * 16 - 10)) / 4),
        ("survival", [0, 1.0, 0, 0], (8 + 4 - 10 - 10) / 4),
        # At the threshold is not beyond it.
        ("paper", [0, 0.9, 0, 0], sum(MIXED_VALUES) / 4),
        ("shift", [0, 0.9, 0, 0], sum(MIXED_VALUES) / 4),
        # The observed state is alive, whatever D says; after the last step nothing follows.
        ("paper", [1.0, 0, 0, 0], sum(MIXED_VALUES) / 4),
        ("survival", [1.0, 0, 0, 1.0], sum(MIXED_VALUES) / 4),
        # Dead stays dead.
        ("paper", [0, 0.95, 0.0, 0.0], (8 + 4) / 4),
    ],
)
def test_the_objective_after_a_failure(rule: str, deaths: list[float], expected: float) -> None:
    found = _value(deaths, values=MIXED_VALUES, termination_rule=rule)
    assert found == pytest.approx(expected)


def test_only_the_papers_rule_rewards_falling_when_values_are_negative() -> None:
    values, dead = [-1.0, -1.0, -5.0, -5.0], [0.0, 1.0, 0.0, 0.0]
    gain = {
        rule: _value(dead, values=values, termination_rule=rule)
        - _value(ALIVE, values=values, termination_rule=rule)
        for rule in RULES
    }
    assert gain["paper"] > 0
    assert gain["shift"] < 0
    assert gain["survival"] < 0


# --- against a loop ------------------------------------------------------------------------
def _model() -> WorldModel:
    model = toy_model(EARNING)
    model.return_mean.fill_(0.3)
    model.return_std.fill_(2.0)
    model.min_return.fill_(-4.0)
    model.discount.fill_(0.8)
    return model


def _carry(robots: int) -> Carry:
    rng = torch.Generator().manual_seed(0)
    h = 2 * torch.rand(robots, DEBUG.hidden, generator=rng) - 1
    return Carry(h, torch.randn(robots, DEBUG.latent, generator=rng))


def _plans(robots: int, plans: int, length: int) -> Tensor:
    rng = torch.Generator().manual_seed(1)
    return 2 * torch.rand(robots, plans, length, spec.ACTION_DIM, generator=rng) - 1


def _by_loop(model: WorldModel, carry: Carry, plan: Tensor, config: PlannerConfig) -> float:
    """V of one plan (A, 7) of one robot, one number at a time."""
    n, gamma = config.horizon, float(model.discount)
    floor = 0.0 if config.termination_rule == "paper" else float(model.min_return)
    total, share = 0.0, 1.0
    ends = n if config.objective == "td" else n - 1
    for k in range(ends + 1):
        action = plan[k : k + 1]
        if k == n or config.objective == "value":
            value, worst = float(model.value(carry, action)), floor
        else:
            value, worst = float(model.reward(carry, action)), (1 - gamma) * floor
        weight = 1 / n if config.objective == "value" else gamma**k
        total += weight * (share * value + (1 - share) * worst)
        dead = float(model.termination(carry))
        if 0 < k < ends:
            share *= 1 - dead if config.termination_rule == "survival" else float(dead <= 0.5)
        carry = model.imagine(carry, action)
    return total


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("horizon", range(1, 7))
def test_batched_plan_values_equal_single_ones(objective: Any, horizon: int, rule: Any) -> None:
    model, robots, plans = _model(), 2, 5
    config = plain_planner(
        horizon=horizon, objective=objective, termination_rule=rule, termination_threshold=0.5
    )
    carry, actions = _carry(robots), _plans(robots, plans, config.actions)
    with torch.no_grad():
        found = evaluate(model, carry, actions, config)
        for e in range(robots):
            start = Carry(carry.h[e : e + 1], carry.z[e : e + 1])
            for m in range(plans):
                expected = _by_loop(model, start, actions[e, m], config)
                assert found[e, m].item() == pytest.approx(expected, abs=1e-4)


def test_reference_loop_covers_failures_and_survivals() -> None:
    """The comparison above covers the rules only if some plans fail and some survive."""
    model, actions = _model(), _plans(2, 5, 6)
    with torch.no_grad():
        carry = model.expand_candidates(_carry(2))
        dead = []
        for action in actions.unbind(-2):
            carry = model.imagine(carry, action)
            dead.append(model.termination(carry) > 0.5)
    share = torch.stack(dead).float().mean()
    assert 0.05 < share < 0.95


# --- the search ---------------------------------------------------------------------------
class _Earning(PointWorld):
    """A point that earns its negative squared distance from the goal.

    Q has another optimum: half the goal.
    """

    discount = torch.tensor(0.9)

    def reward(self, carry: Point, action: Tensor) -> Tensor:
        return -(action - carry.goal).square().sum(-1)

    def value(self, carry: Point, action: Tensor) -> Tensor:
        return -(action - 0.5 * carry.goal).square().sum(-1)


def test_the_search_finds_the_plan_with_the_highest_reward() -> None:
    executed, goal = torch.zeros(1, 7), torch.full((1, 7), 0.5)
    for objective, expected in (("reward", [0.32, 0.5]), ("td", [0.32, 0.5, 0.25])):
        config = plain_planner(horizon=2, objective=objective, iterations=10)  # type: ignore[arg-type]
        evaluator, rng = ReferenceEvaluator(_Earning(), config), torch.Generator().manual_seed(0)
        search = optimiser_of(config)
        plan = make_plan(evaluator, search, Point(executed, goal), executed, config, rng)
        best = torch.tensor(expected)[None, :, None].expand(1, -1, 7)
        torch.testing.assert_close(plan.actions, best, atol=0.06, rtol=0)


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("horizon", [1, 6])
def test_a_policy_acts_by_every_objective_and_horizon(objective: Any, horizon: int) -> None:
    config = plain_planner(samples=16, elites=4, iterations=2, horizon=horizon, objective=objective)
    policy = Policy(_model(), config, num_envs=2)
    rng = np.random.default_rng(0)
    for _ in range(3):
        depth = rng.integers(300, 5000, (2, spec.DEPTH_ROWS, spec.DEPTH_COLS)).astype(np.uint16)
        step = policy.act(depth, rng.normal(size=(2, spec.STATE_DIM)).astype(np.float32))
        assert step.plan.shape == (2, config.actions, spec.ACTION_DIM)
        np.testing.assert_array_equal(step.action, step.plan[:, 0])
        assert np.isfinite(step.value).all()
        policy.advance(step.action)
    assert config.actions == horizon + (objective == "td")


# --- backends and refusals ----------------------------------------------------------------
class _Subclass(WorldModel):
    """It could override methods that the packed networks do not call."""


@pytest.mark.parametrize("objective", ["reward", "td"])
def test_only_eager_and_subclasses_use_the_reference(objective: Any) -> None:
    for backend, slow in (("auto", False), ("eager", True)):
        config = plain_planner(objective=objective, backend=backend)  # type: ignore[arg-type]
        assert isinstance(make_evaluator(_model(), config), ReferenceEvaluator) == slow
    subclass = _Subclass(EARNING).requires_grad_(False).eval()
    config = plain_planner(objective=objective, backend="auto")
    assert isinstance(make_evaluator(subclass, config), ReferenceEvaluator)


@pytest.mark.parametrize("objective", ["reward", "td"])
def test_a_model_without_reward_head_is_refused(objective: Any) -> None:
    config = plain_planner(objective=objective)
    with pytest.raises(UsageError, match=r"--policy\.loss\.reward=1"):
        make_evaluator(toy_model(), config)


def test_sampling_from_an_untrained_prior_std_is_refused() -> None:
    autoregressive = dataclasses.replace(DEBUG, dynamics="autoregressive")
    with pytest.raises(UsageError, match="plan with latent=mean"):
        require_compatible(autoregressive, plain_planner(latent="sample"))
    require_compatible(autoregressive, plain_planner())
    require_compatible(DEBUG, plain_planner(latent="sample"))
