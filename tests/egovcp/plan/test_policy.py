"""The world model as a policy: filtering and planning."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp import spec
from egovcp.model import Carry, WorldModel
from egovcp.plan import Optimiser, Plan, PlanEvaluator, PlannerConfig, Policy, PolicyStep, make_plan
from egovcp.plan.objective import MirroredEvaluator, mirrored_actions
from egovcp.plan.search import shift
from egovcp.robot_spec import G1
from egovcp.testing import toy_model
from tests.support.models import CountingModel
from tests.support.worlds import plain_planner

CONFIG = plain_planner(samples=64, elites=8, iterations=2)
A = spec.ACTION_DIM


class Sight(NamedTuple):
    """One step's observation of E robots."""

    depth: NDArray[np.uint16]
    state: NDArray[np.float32]


def _see(robots: int, tick: int) -> Sight:
    rng = np.random.default_rng(tick)
    depth = rng.integers(300, 5000, (robots, spec.DEPTH_ROWS, spec.DEPTH_COLS))
    state = rng.normal(size=(robots, spec.STATE_DIM))
    return Sight(depth.astype(np.uint16), state.astype(np.float32))


def _rows(sight: Sight, rows: list[int]) -> Sight:
    return Sight(sight.depth[rows], sight.state[rows])


def _run(policy: Policy, ticks: int, robots: int = 2) -> list[PolicyStep]:
    steps = []
    for tick in range(ticks):
        steps.append(policy.act(*_see(robots, tick)))
        policy.advance(steps[-1].action)
    return steps


def _led(carry: Carry) -> Tensor:
    """The action that led to the state of a `CountingModel`."""
    return carry.z[:, :A]


def test_the_recurrence_advances_with_the_action_sent_not_with_the_planned_one() -> None:
    policy = Policy(CountingModel(drift=0.3), CONFIG, num_envs=2)
    sent = np.zeros((2, A))
    for tick in range(4):
        step = policy.act(*_see(2, tick))
        np.testing.assert_allclose(_led(policy.carry).numpy(), sent, atol=1e-6)
        assert policy.carry.h[:, CountingModel.COUNT].tolist() == [tick + 1] * 2
        assert np.abs(step.action - sent).max() > 0.01
        sent = 0.5 * step.action + np.array([[0.1], [-0.1]])
        policy.advance(sent)


def test_the_plan_starts_from_the_action_sent() -> None:
    policy = Policy(CountingModel(), CONFIG, num_envs=1)
    policy.act(*_see(1, 0))
    sent = np.full((1, A), 0.8)
    policy.advance(sent)
    step = policy.act(*_see(1, 1))
    assert np.abs(step.action - sent).max() <= spec.ACTION_ETA + 1e-6
    assert np.abs(step.candidates[:, :, 0] - sent[:, None]).max() <= spec.ACTION_ETA + 1e-6


def test_the_policy_keeps_no_reference_to_the_callers_action() -> None:
    policy = Policy(CountingModel(), CONFIG, num_envs=1)
    policy.act(*_see(1, 0))
    sent = np.full((1, A), 0.2, dtype=np.float32)
    policy.advance(sent)
    sent[:] = 9.0
    policy.act(*_see(1, 1))
    np.testing.assert_allclose(_led(policy.carry).numpy(), 0.2, atol=1e-6)


def test_action_of_a_step_does_not_share_memory_with_its_plan() -> None:
    step = Policy(toy_model(), CONFIG, num_envs=1).act(*_see(1, 0))
    plan = step.plan.copy()
    step.action[:] = 9.0
    np.testing.assert_array_equal(step.plan, plan)


def test_run_starts_with_zero_state_and_the_neutral_action() -> None:
    policy = Policy(CountingModel(), CONFIG, num_envs=2)
    policy.act(*_see(2, 0))
    assert not _led(policy.carry).any()
    assert policy.carry.h[:, CountingModel.COUNT].tolist() == [1, 1]


class _PlanCall(NamedTuple):
    """Arguments and result of a plan."""

    warm: Tensor
    discount: Tensor
    plan: Plan


@pytest.fixture
def plan_calls(monkeypatch: pytest.MonkeyPatch) -> list[_PlanCall]:
    """Every call of the planner by a policy."""
    calls: list[_PlanCall] = []

    def record(
        evaluator: PlanEvaluator[Carry],
        optimiser: Optimiser,
        carry: Carry,
        executed: Tensor,
        config: PlannerConfig,
        generator: torch.Generator,
        warm: Tensor,
        remaining: Callable[[], float] | None,
        discount: Tensor,
    ) -> Plan:
        plan = make_plan(
            evaluator, optimiser, carry, executed, config, generator, warm, remaining, discount
        )
        calls.append(_PlanCall(warm.clone(), discount, plan))
        return plan

    monkeypatch.setattr("egovcp.plan.policy.make_plan", record)
    return calls


def test_each_plan_starts_at_the_shifted_one_before(plan_calls: list[_PlanCall]) -> None:
    _run(Policy(CountingModel(drift=0.3), CONFIG, num_envs=2), 4)
    assert not plan_calls[0].warm.any()
    for before, now in itertools.pairwise(plan_calls):
        assert torch.equal(now.warm, shift(before.plan.deltas))
        assert before.plan.deltas.any()


def test_costs_of_actions_have_the_discount_of_the_model(plan_calls: list[_PlanCall]) -> None:
    model = CountingModel()
    model.discount.fill_(0.9)
    _run(Policy(model, CONFIG, num_envs=2), 1)
    assert float(plan_calls[0].discount) == pytest.approx(0.9)


def test_a_seed_repeats_a_run_and_a_full_reset_starts_it_again() -> None:
    model = toy_model()
    first = Policy(model, CONFIG, num_envs=2, seed=5)
    one = _run(first, 3)
    first.reset()
    for steps in (_run(Policy(model, CONFIG, 2, seed=5), 3), _run(first, 3)):
        for a, b in zip(one, steps, strict=True):
            np.testing.assert_array_equal(a.plan, b.plan)
            np.testing.assert_array_equal(a.candidates, b.candidates)
    other = _run(Policy(model, CONFIG, num_envs=2, seed=6), 3)
    assert not np.array_equal(one[0].plan, other[0].plan)


def test_actions_of_a_robot_do_not_depend_on_others() -> None:
    model = toy_model()
    crowd, alone = Policy(model, CONFIG, num_envs=3), Policy(model, CONFIG, num_envs=1)
    for tick in range(3):
        sight = _see(3, tick)
        together, single = crowd.act(*sight), alone.act(*_rows(sight, [2]))
        np.testing.assert_allclose(together.plan[2:], single.plan, atol=0.02)
        sent = np.tile(single.action, (3, 1))
        crowd.advance(sent)
        alone.advance(sent[2:])


def test_policy_step_has_its_shapes_and_stays_in_the_box() -> None:
    policy = Policy(toy_model(), CONFIG, num_envs=2)
    for step in _run(policy, 3):
        assert step.action.shape == (2, A)
        assert step.plan.shape == (2, CONFIG.horizon, A)
        assert step.value.shape == step.termination.shape == (2,)
        assert step.candidates.shape == (2, CONFIG.elites, CONFIG.horizon, A)
        assert step.candidate_values.shape == (2, CONFIG.elites)
        assert np.abs(step.plan).max() <= 1
        np.testing.assert_array_equal(step.action, step.plan[:, 0])
        assert ((step.termination >= 0) & (step.termination <= 1)).all()


def test_the_plan_goes_on_from_the_one_before() -> None:
    """Warm start: with hardly any search, a drift is followed farther step by step."""
    lazy = plain_planner(samples=32, elites=4, iterations=1)
    policy = Policy(CountingModel(drift=0.25), lazy, num_envs=1, seed=1)
    values = []
    for tick in range(8):
        values.append(float(policy.act(*_see(1, tick)).value[0]))
        policy.advance(np.zeros((1, A)))
    assert min(values[4:]) > values[0]


@pytest.mark.parametrize("horizon", [1, 4, 7])
def test_imagined_images_follow_the_plan_and_then_hold_its_last_action(horizon: int) -> None:
    model = toy_model()
    policy = Policy(model, CONFIG, num_envs=2)
    plan = policy.act(*_see(2, 0)).plan
    frames = policy.imagine(plan, horizon)
    assert frames.shape == (2, horizon, spec.DEPTH_ROWS, spec.DEPTH_COLS)
    carry = policy.carry
    held = np.concatenate([plan, np.repeat(plan[:, -1:], 3, axis=1)], axis=1)
    with torch.no_grad():
        for k in range(horizon):
            carry = model.imagine(carry, torch.from_numpy(held[:, k]))
        np.testing.assert_allclose(frames[:, -1], model.decode(carry)[0].numpy(), atol=1e-5)


def test_decoding_and_imagining_do_not_change_the_policy() -> None:
    model = toy_model()
    quiet, curious = (Policy(model, CONFIG, num_envs=1, seed=3) for _ in range(2))
    for tick in range(3):
        a, b = (p.act(*_see(1, tick)) for p in (quiet, curious))
        curious.reconstruct()
        curious.imagine(b.plan, 5)
        np.testing.assert_array_equal(a.plan, b.plan)
        quiet.advance(a.action)
        curious.advance(b.action)


def test_the_reconstruction_is_depth_in_metres() -> None:
    policy = Policy(toy_model(), CONFIG, num_envs=2)
    policy.act(*_see(2, 0))
    depth = policy.reconstruct()
    assert depth.shape == (2, spec.DEPTH_ROWS, spec.DEPTH_COLS)
    assert depth.min() >= 0
    assert depth.max() <= spec.DEPTH_MAX_M


def test_a_policy_puts_its_model_into_evaluation_mode() -> None:
    model: WorldModel = toy_model().train()
    assert not Policy(model, CONFIG, num_envs=1).model.training


def _mirrored(sight: Sight) -> Sight:
    return Sight(sight.depth[..., ::-1].copy(), G1.mirrored_state(sight.state))


def test_a_plan_has_the_same_value_in_a_mirror() -> None:
    """Of an untrained model, whose Q is not symmetric at all."""
    policy, other = (Policy(toy_model(), PlannerConfig(), 3) for _ in range(2))
    sent = np.random.default_rng(0).uniform(-1, 1, (3, A)).astype(np.float32)
    for tick in range(3):
        policy.observe(*_see(3, tick))
        other.observe(*_mirrored(_see(3, tick)))
        policy.advance(sent)
        other.advance(G1.mirrored_action(sent))
    plans = torch.rand(3, 5, 4, A, generator=torch.Generator().manual_seed(0)) * 2 - 1
    found, expected = (
        MirroredEvaluator(p.prepare(), G1).at(p._carry)(actions, None)
        for p, actions in ((policy, plans), (other, mirrored_actions(plans, G1)))
    )
    torch.testing.assert_close(found, expected)
    one_view = policy.prepare().at(policy.carry)(plans, None)
    assert (one_view - found).abs().max() > 1e-3


def test_a_policy_plans_with_both_views_by_default() -> None:
    config = plain_planner(samples=64, elites=8, iterations=2, mirror=False)
    one_view = _run(Policy(toy_model(), config, 2), 3)
    both = _run(Policy(toy_model(), dataclasses.replace(config, mirror=True), 2), 3)
    assert not np.allclose(one_view[-1].plan, both[-1].plan)
    assert PlannerConfig().mirror


@pytest.mark.parametrize("mirror", [True, False])
def test_a_robot_that_is_not_symmetric_plans_without_a_mirror(mirror: bool) -> None:
    model = toy_model()
    model.robot = dataclasses.replace(model.robot, mirror=None)
    config = dataclasses.replace(CONFIG, mirror=mirror)
    steps = _run(Policy(model, config, 2), 3)
    plain = _run(Policy(toy_model(), dataclasses.replace(CONFIG, mirror=False), 2), 3)
    for step, expected in zip(steps, plain, strict=True):
        np.testing.assert_array_equal(step.plan, expected.plan)
