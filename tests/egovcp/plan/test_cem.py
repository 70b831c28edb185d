"""The planner on worlds whose best plan is known."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.model import Carry
from egovcp.plan import Plan, PlannerConfig, ReferenceEvaluator, make_plan, optimiser_of
from egovcp.plan.config import TerminationRule
from egovcp.plan.objective import Dynamics, evaluate
from egovcp.plan.search import random_walk, shift
from egovcp.testing import toy_model
from tests.support.worlds import Point, PointWorld, plain_planner

ETA = spec.ACTION_ETA
SMALL = plain_planner(samples=256, elites=32, iterations=4)


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _search[L](
    world: Dynamics[L],
    carry: L,
    executed: Tensor,
    config: PlannerConfig,
    generator: torch.Generator,
    warm: Tensor | None = None,
) -> Plan:
    evaluator, optimiser = ReferenceEvaluator(world, config), optimiser_of(config)
    return make_plan(evaluator, optimiser, carry, executed, config, generator, warm)


def _plan(
    executed: Tensor,
    goal: Tensor,
    config: PlannerConfig = SMALL,
    warm: Tensor | None = None,
    world: PointWorld | None = None,
    seed: int = 0,
) -> Plan:
    world = world or PointWorld()
    return _search(world, world.start(executed, goal), executed, config, _generator(seed), warm)


def _random(rows: int, seed: int, scale: float = 1.0) -> Tensor:
    return scale * (2 * torch.rand(rows, spec.ACTION_DIM, generator=_generator(seed)) - 1)


# --- the search ---------------------------------------------------------------------------
@pytest.mark.parametrize("seed", range(3))
def test_the_best_reachable_plan_is_found(seed: int) -> None:
    """A goal beyond one step: walk towards it as fast as the process allows, then stay."""
    executed, goal = torch.zeros(1, 7), torch.full((1, 7), 0.5)
    plan = _plan(executed, goal, plain_planner(iterations=6), seed=seed)
    ideal = torch.tensor([ETA, 0.5, 0.5, 0.5])[None, :, None].expand(1, 4, 7)
    regret = evaluate(PointWorld(), Point(executed, goal), ideal[:, None], SMALL) - evaluate(
        PointWorld(), Point(executed, goal), plan.actions[:, None], SMALL
    )
    assert 0 <= regret.item() < 0.08
    assert (plan.actions - ideal).abs().mean() < 0.08


def test_pose_cost_moves_the_plan_towards_neutral() -> None:
    """Q is -|a - goal|^2, so that a plan that holds a loses 7 (goal - a)^2 and costs c g a^2, where
    g is the sum of gamma^k over the steps of a return: for c = 7 / g the best a is goal / 2."""
    executed, goal = torch.full((1, 7), 0.2), torch.full((1, 7), 0.4)
    config = plain_planner(
        samples=512, elites=16, iterations=8, min_std=0.02, action_parameterization="target"
    )
    free = _plan(executed, goal, config).actions[0, -1]
    torch.testing.assert_close(free, goal[0], atol=0.05, rtol=0)
    discounts = sum(spec.GAMMA**k for k in range(spec.RETURN_STEPS))
    costly = dataclasses.replace(config, pose_cost=7 / discounts)
    held = _plan(executed, goal, costly).actions[0, -1]
    torch.testing.assert_close(held, goal[0] / 2, atol=0.05, rtol=0)


@pytest.mark.parametrize("cost", [-0.1, math.inf, math.nan])
def test_pose_cost_is_a_number_from_zero_up(cost: float) -> None:
    with pytest.raises(UsageError, match=f"pose_cost={cost}: expected"):
        plain_planner(pose_cost=cost)


def test_a_goal_within_reach_is_met_at_once() -> None:
    executed = _random(4, 2, scale=0.5)
    goal = executed + 0.1
    plan = _plan(executed, goal, plain_planner(horizon=2, iterations=6))
    assert (plan.actions - goal[:, None]).abs().mean() < 0.04


def test_more_iterations_find_better_plans() -> None:
    executed, goal = _random(8, 3), _random(8, 4)
    one, six = (_plan(executed, goal, dataclasses.replace(SMALL, iterations=n)) for n in (1, 6))
    assert (six.value > one.value).all()


def test_actions_stay_in_the_box_and_steps_within_eta() -> None:
    executed, goal = _random(16, 5).sign() * 0.99, _random(16, 6).sign() * 3.0
    plan = _plan(executed, goal)
    for actions in (plan.actions[:, None], plan.candidates):
        assert actions.abs().max() <= 1
        start = executed[:, None, None].expand(-1, actions.shape[1], 1, -1)
        steps = (actions - torch.cat([start, actions[:, :, :-1]], 2)).abs()
        assert steps.max() <= ETA + 1e-6
    torch.testing.assert_close(random_walk(executed, plan.deltas, ETA), plan.actions)


def test_a_robots_plan_does_not_depend_on_the_others() -> None:
    executed, goal = _random(5, 7), _random(5, 8)
    together = _plan(executed, goal)
    for e in range(5):
        alone = _plan(executed[e : e + 1], goal[e : e + 1])
        for name in ("actions", "deltas", "value", "candidates", "candidate_values"):
            torch.testing.assert_close(
                getattr(together, name)[e : e + 1], getattr(alone, name), rtol=0, atol=1e-6
            )


def test_a_robots_plan_in_a_world_model_does_not_depend_on_the_others() -> None:
    model, executed = toy_model(), _random(3, 9)
    rng = _generator(10)
    carry = Carry(
        torch.randn(3, model.config.hidden, generator=rng),
        torch.randn(3, model.config.latent, generator=rng),
    )
    with torch.no_grad():
        together = _search(model, carry, executed, SMALL, _generator())
        for e in range(3):
            row = Carry(carry.h[e : e + 1], carry.z[e : e + 1])
            alone = _search(model, row, executed[e : e + 1], SMALL, _generator())
            torch.testing.assert_close(
                together.actions[e : e + 1], alone.actions, rtol=0, atol=0.02
            )


def test_a_generator_repeats_a_plan_and_another_seed_gives_another() -> None:
    executed, goal = _random(2, 11), _random(2, 12)
    assert torch.equal(_plan(executed, goal).actions, _plan(executed, goal).actions)
    assert not torch.equal(_plan(executed, goal).actions, _plan(executed, goal, seed=1).actions)


def test_global_random_state_is_unchanged() -> None:
    before = torch.random.get_rng_state()
    _plan(_random(2, 11), _random(2, 12))
    assert torch.equal(before, torch.random.get_rng_state())


def test_inputs_are_unchanged() -> None:
    executed, goal, warm = _random(2, 13), _random(2, 14), torch.full((2, 4, 7), 0.3)
    copies = executed.clone(), goal.clone(), warm.clone()
    _plan(executed, goal, warm=warm)
    for now, before in zip((executed, goal, warm), copies, strict=True):
        assert torch.equal(now, before)


def test_the_elites_are_the_best_first_and_belong_to_their_values() -> None:
    executed, goal = _random(3, 15), _random(3, 16)
    plan = _plan(executed, goal)
    assert (plan.candidate_values.diff(dim=1) <= 0).all()
    world = PointWorld()
    values = evaluate(world, world.start(executed, goal), plan.candidates, SMALL)
    torch.testing.assert_close(values, plan.candidate_values)
    torch.testing.assert_close(plan.value, plan.candidate_values.mean(1))
    assert plan.iterations == SMALL.iterations


def test_the_std_stays_above_its_minimum() -> None:
    executed, goal = torch.zeros(1, 7), torch.full((1, 7), 0.1)
    for floor in (0.1, 0.4):
        config = plain_planner(samples=512, elites=64, iterations=10, min_std=floor)
        first_steps = _plan(executed, goal, config).candidates[:, :, 0] / ETA
        assert 0.5 * floor < first_steps.std(1).mean() < 1.5 * floor


def test_a_warm_start_helps_a_short_search() -> None:
    executed, goal = _random(8, 17), _random(8, 18)
    hasty = plain_planner(samples=32, elites=4, iterations=1)
    best = _plan(executed, goal, plain_planner(iterations=6))
    cold = _plan(executed, goal, hasty)
    warm = _plan(executed, goal, hasty, warm=best.deltas)
    assert (warm.value > cold.value).all()


def test_the_previous_plan_itself_is_a_candidate() -> None:
    """So that replanning never does worse than going on, as the model sees it."""
    executed, goal = _random(4, 19), _random(4, 20)
    best = _plan(executed, goal, plain_planner(iterations=8))
    again = _plan(executed, goal, plain_planner(samples=8, elites=1, iterations=1), best.deltas)
    world = PointWorld()
    kept = evaluate(world, world.start(executed, goal), best.actions[:, None], SMALL)[:, 0]
    assert (again.value >= kept - 1e-6).all()


def test_the_shifted_plan_drops_its_first_step_and_ends_at_rest() -> None:
    deltas = torch.arange(4.0)[None, :, None].expand(2, 4, 7)
    expected = torch.tensor([1.0, 2.0, 3.0, 0.0])[None, :, None].expand(2, 4, 7)
    assert torch.equal(shift(deltas), expected)


def test_a_single_candidate_is_the_warm_start() -> None:
    warm = torch.full((2, 4, 7), 0.25)
    plan = _plan(torch.zeros(2, 7), torch.ones(2, 7), plain_planner(samples=1, elites=1), warm=warm)
    torch.testing.assert_close(plan.deltas, warm)


def test_a_horizon_of_one_is_greedy() -> None:
    executed, goal = _random(4, 21, scale=0.5), _random(4, 22, scale=0.5)
    plan = _plan(executed, goal, plain_planner(horizon=1, iterations=6))
    nearest = executed + (goal - executed).clamp(-ETA, ETA)
    assert plan.actions.shape == (4, 1, 7)
    assert (plan.actions[:, 0] - nearest).abs().mean() < 0.03


@pytest.mark.parametrize(
    "change",
    [
        {"samples": 0},
        {"horizon": 0},
        {"iterations": 0},
        {"elites": 0},
        {"samples": 8, "elites": 9},
        {"eta": 0.0},
        {"eta": 2.5},
    ],
)
def test_invalid_settings_are_refused(change: dict[str, int]) -> None:
    with pytest.raises(UsageError):
        plain_planner(**change)  # type: ignore[arg-type]


# --- failures ---------------------------------------------------------------------------------
@pytest.mark.parametrize("rule", ["shift", "survival"])
def test_the_plan_stops_before_the_cliff(rule: TerminationRule) -> None:
    executed, goal = torch.zeros(1, 7), torch.full((1, 7), 0.9)
    config = plain_planner(iterations=6, termination_rule=rule)
    bold = _plan(executed, goal, config)
    careful = _plan(executed, goal, config, world=PointWorld(cliff=0.5))
    assert bold.actions[0, 1, 0] > 0.55
    assert careful.actions[0, :2, 0].max() <= 0.5
    assert careful.actions[0, 1, 1:].mean() > 0.5


# --- numbers that are none -------------------------------------------------------------------
class _Broken(PointWorld):
    """Q is not a number wherever the first coordinate is positive."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.broken = value

    def value(self, carry: Point, action: Tensor) -> Tensor:
        return super().value(carry, action).masked_fill(action[..., 0] > 0, self.broken)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("elites", [4, 200])
def test_plans_without_a_finite_value_are_never_chosen(value: float, elites: int) -> None:
    """Even where fewer than the wanted elites have one."""
    config = plain_planner(samples=256, elites=elites)
    plan = _plan(torch.zeros(1, 7), torch.full((1, 7), 0.5), config, world=_Broken(value))
    finite = plan.candidate_values.isfinite()
    assert finite.any()
    assert (plan.candidates[finite][..., 0] <= 0).all()
    assert (plan.actions[..., 0] <= 1e-6).all()
    assert plan.value.isfinite().all()


def test_a_region_without_finite_values_does_not_stop_the_search() -> None:
    goal = torch.full((1, 7), 0.3)
    plan = _plan(torch.zeros(1, 7), goal, plain_planner(iterations=6), world=_Broken(math.nan))
    assert plan.actions[..., 0].abs().max() < 0.15
    assert (plan.actions[..., 1:] - 0.3).abs().mean() < 0.1


def test_without_finite_values_the_plan_continues_and_its_value_is_minus_infinity() -> None:
    class Nan(PointWorld):
        def value(self, carry: Point, action: Tensor) -> Tensor:
            return torch.full(action.shape[:-1], math.nan)

    warm = torch.full((2, 4, 7), 0.25)
    plan = _plan(torch.zeros(2, 7), torch.ones(2, 7), warm=warm, world=Nan())
    torch.testing.assert_close(plan.deltas, warm)
    assert plan.actions.isfinite().all()
    assert (plan.value == -math.inf).all()


def test_robot_without_finite_values_does_not_affect_others() -> None:
    executed, goal = torch.zeros(2, 7), torch.full((2, 7), 0.2)
    broken = goal.clone()
    broken[1] = math.nan
    plan = _plan(executed, broken)
    alone = _plan(executed[:1], goal[:1])
    torch.testing.assert_close(plan.actions[:1], alone.actions, rtol=0, atol=1e-6)
    assert plan.actions.isfinite().all()


# --- options that not every model can answer ------------------------------------------------
class _NoisyWorld(PointWorld):
    """Samples states that are off by a noise common to all candidates."""

    def imagine_sample(
        self, carry: Point, action: Tensor, generator: torch.Generator | None = None
    ) -> Point:
        noise = torch.randn(7, generator=generator)
        return Point(action, carry.goal + noise)


def test_sampled_states_use_the_generator_of_the_planner() -> None:
    executed, goal = _random(2, 0), _random(2, 1)
    config = dataclasses.replace(SMALL, latent="sample")
    one, again, other = (
        _plan(executed, goal, config, world=_NoisyWorld(), seed=seed) for seed in (0, 0, 1)
    )
    assert torch.equal(one.actions, again.actions)
    assert not torch.equal(one.actions, other.actions)
    assert not torch.equal(one.value, _plan(executed, goal, world=_NoisyWorld()).value)


def test_candidates_share_the_noise_of_sampled_states() -> None:
    """Two equal plans are worth the same, whatever was drawn."""
    executed, goal = _random(2, 0), _random(2, 1)
    plans = _random(2, 2)[:, None, None].expand(2, 5, 4, 7)
    config = dataclasses.replace(SMALL, latent="sample")
    values = evaluate(_NoisyWorld(), Point(executed, goal), plans, config, _generator())
    torch.testing.assert_close(values, values[:, :1].expand_as(values))
