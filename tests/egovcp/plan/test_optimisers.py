"""The searches, and the cross-entropy method of the kernel."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.plan import Plan, PlannerConfig, ReferenceEvaluator, make_plan, optimiser_of
from egovcp.plan.backends import library
from egovcp.plan.config import OptimiserName
from egovcp.plan.objective import evaluate
from egovcp.plan.optimisers import OPTIMISERS, CrossEntropy, KernelCrossEntropy, coloured, weights
from egovcp.plan.search import SearchState, random_walk
from tests.support.worlds import Point, PointWorld, plain_planner

ETA = spec.ACTION_ETA
every = pytest.mark.parametrize("name", list(OPTIMISERS))


def _plan(
    name: OptimiserName,
    executed: Tensor,
    goal: Tensor,
    warm: Tensor | None = None,
    world: PointWorld | None = None,
    seed: int = 0,
    **change: object,
) -> Plan:
    settings = {"samples": 256, "elites": 32, "iterations": 4, **change}
    config = plain_planner(optimiser=name, **settings)  # type: ignore[arg-type]
    world = world or PointWorld()
    evaluator, carry = ReferenceEvaluator(world, config), world.start(executed, goal)
    generator = torch.Generator().manual_seed(seed)
    return make_plan(evaluator, optimiser_of(config), carry, executed, config, generator, warm)


def _random(rows: int, seed: int, scale: float = 1.0) -> Tensor:
    rng = torch.Generator().manual_seed(seed)
    return scale * (2 * torch.rand(rows, spec.ACTION_DIM, generator=rng) - 1)


def _worth(executed: Tensor, goal: Tensor, actions: Tensor) -> Tensor:
    return evaluate(PointWorld(), Point(executed, goal), actions[:, None], plain_planner())[:, 0]


@every
def test_optimum_of_a_quadratic_is_found(name: OptimiserName) -> None:
    """Better than all but the best of what chance finds; the refining searches come close."""
    executed = _random(4, 0, scale=0.4)
    goal = executed + 0.15
    plan = _plan(name, executed, goal, samples=1024, elites=64, iterations=8)
    ideal = _worth(executed, goal, goal[:, None].expand(-1, 4, -1))
    still = _worth(executed, goal, executed[:, None].expand(-1, 4, -1))
    regret = (ideal - _worth(executed, goal, plan.actions)) / (ideal - still)
    assert (regret >= -1e-6).all()
    assert regret.max() < (0.9 if name == "shooting" else 0.1)


@every
def test_a_robots_plan_does_not_depend_on_the_others(name: OptimiserName) -> None:
    executed, goal = _random(4, 1), _random(4, 2)
    together = _plan(name, executed, goal)
    for e in range(4):
        alone = _plan(name, executed[e : e + 1], goal[e : e + 1])
        for field in ("actions", "deltas", "value", "candidates", "candidate_values"):
            torch.testing.assert_close(
                getattr(together, field)[e : e + 1], getattr(alone, field), rtol=0, atol=1e-5
            )


@every
def test_a_seed_repeats_a_plan_and_another_gives_another(name: OptimiserName) -> None:
    executed, goal = _random(2, 3), _random(2, 4)
    assert torch.equal(_plan(name, executed, goal).actions, _plan(name, executed, goal).actions)
    other = _plan(name, executed, goal, seed=1)
    assert not torch.equal(_plan(name, executed, goal).actions, other.actions)


@every
def test_the_first_candidate_is_the_warm_start(name: OptimiserName) -> None:
    config = plain_planner(samples=16, elites=4, optimiser=name)
    warm = torch.full((2, 4, 7), 0.3)
    nothing = torch.full((2, 4), -math.inf)
    state = SearchState(
        warm, warm.abs(), warm[:, None].expand(-1, 4, -1, -1), nothing, nothing[:, 0]
    )
    first = optimiser_of(config).propose(state, 0, torch.Generator().manual_seed(0))
    assert first.shape == (2, 16, 4, 7)
    assert torch.equal(first[:, 0], warm)
    assert not first[:, 1].any()
    assert first.abs().max() <= 1


@every
def test_replanning_keeps_a_good_plan(name: OptimiserName) -> None:
    executed, goal = _random(4, 5), _random(4, 6)
    good = _plan("cem", executed, goal, iterations=8)
    again = _plan(name, executed, goal, good.deltas, samples=8, elites=1, iterations=1)
    assert (again.candidate_values[:, 0] >= _worth(executed, goal, good.actions) - 1e-6).all()


@every
def test_actions_stay_in_the_box_and_steps_within_eta(name: OptimiserName) -> None:
    executed, goal = _random(8, 7).sign() * 0.99, 3.0 * _random(8, 8).sign()
    plan = _plan(name, executed, goal)
    for actions in (plan.actions[:, None], plan.candidates):
        assert actions.abs().max() <= 1
        start = executed[:, None, None].expand(-1, actions.shape[1], 1, -1)
        assert (actions - torch.cat([start, actions[:, :, :-1]], 2)).abs().max() <= ETA + 1e-6


class _Broken(PointWorld):
    """Q is not a number wherever the first coordinate is positive."""

    def value(self, carry: Point, action: Tensor) -> Tensor:
        return super().value(carry, action).masked_fill(action[..., 0] > 0, math.nan)


@every
def test_plans_without_a_finite_value_are_never_chosen(name: OptimiserName) -> None:
    plan = _plan(name, torch.zeros(1, 7), torch.full((1, 7), 0.5), world=_Broken())
    assert (plan.actions[..., 0] <= 1e-6).all()
    assert plan.value.isfinite().all()


@every
def test_without_finite_values_the_plan_continues_and_its_value_is_minus_infinity(
    name: OptimiserName,
) -> None:
    class Nan(PointWorld):
        def value(self, carry: Point, action: Tensor) -> Tensor:
            return torch.full(action.shape[:-1], math.nan)

    warm = torch.full((2, 4, 7), 0.25)
    plan = _plan(name, torch.zeros(2, 7), torch.ones(2, 7), warm, Nan())
    torch.testing.assert_close(plan.deltas, warm)
    assert (plan.value == -math.inf).all()


@pytest.mark.parametrize("name", ["icem", "shooting"])
def test_optimisers_that_keep_the_best_plan_never_get_worse(name: OptimiserName) -> None:
    executed, goal = _random(4, 9), _random(4, 10)
    values = [_plan(name, executed, goal, iterations=n).value for n in (1, 2, 4, 8)]
    for before, after in itertools.pairwise(values):
        assert (after >= before).all()


def test_icem_samples_fewer_each_iteration_and_repeats_elites() -> None:
    config = plain_planner(samples=100, elites=10, optimiser="icem", kept_elites=0.3)
    elites = torch.rand(1, 10, 4, 7)
    values = torch.arange(10.0, 0.0, -1.0)[None]
    state = SearchState(elites[:, 0], torch.ones(1, 4, 7), elites, values, values[:, 0])
    search, rng = optimiser_of(config), torch.Generator().manual_seed(0)
    counts = [search.propose(state, n, rng).shape[1] for n in range(4)]
    assert counts[0] == 100
    assert counts[1] == 80 + 3
    assert counts[1] > counts[2] > counts[3]
    assert torch.equal(search.propose(state, 1, rng)[:, :3], elites[:, :3])


@pytest.mark.parametrize("exponent", [0.0, 2.0])
def test_coloured_noise_has_unit_variance_and_the_given_spectrum(exponent: float) -> None:
    rng = torch.Generator().manual_seed(0)
    noise = coloured(torch.zeros(1, 8, 7), 4000, exponent, rng)[0]  # (M, N, 7)
    assert noise.std(0).sub(1).abs().max() < 0.05
    alike = (noise[:, 1:] * noise[:, :-1]).mean()
    assert (alike > 0.5) if exponent else (alike.abs() < 0.02)


def test_mppi_weights_do_not_depend_on_the_unit_of_values() -> None:
    values = torch.tensor([[1.0, 2.0, 3.0, -math.inf], [-math.inf] * 4])
    one, thousand = weights(values, 0.5), weights(1000 * values, 0.5)
    torch.testing.assert_close(one, thousand)
    assert one[0].sum().item() == pytest.approx(1)
    assert one[0, 2] > one[0, 1] > one[0, 0] > one[0, 3] == 0
    assert not one[1].any()


@pytest.mark.parametrize(
    "change", [{"temperature": 0.0}, {"kept_elites": 1.1}, {"sample_decay": 0.9}]
)
def test_invalid_settings_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        dataclasses.replace(plain_planner(), **change)


pytestmark = pytest.mark.skipif(library.compiler() is None, reason="no C compiler")
CONFIG = PlannerConfig(samples=60, horizon=3, elites=7)
SHAPE = (CONFIG.horizon, spec.ACTION_DIM)


def _belief(robots: int = 2) -> SearchState:
    rng = torch.Generator().manual_seed(0)
    mean, std = torch.rand(2, robots, *SHAPE, generator=rng)
    nothing = torch.full((robots, CONFIG.elites), -torch.inf)
    elites = mean[:, None].expand(-1, CONFIG.elites, -1, -1)
    return SearchState(2.4 * mean - 1.2, std, elites, nothing, nothing[:, 0])


def _learned(values: Tensor) -> tuple[SearchState, SearchState]:
    """By the kernel, and by torch."""
    rng = torch.Generator().manual_seed(1)
    deltas = 2 * torch.rand(len(values), CONFIG.samples, *SHAPE, generator=rng) - 1
    state = _belief(len(values))
    return (
        KernelCrossEntropy(CONFIG).update(state, deltas, values),
        CrossEntropy(CONFIG).update(state, deltas, values),
    )


def _values(robots: int = 2) -> Tensor:
    return torch.randn(robots, CONFIG.samples, generator=torch.Generator().manual_seed(2))


def test_kernel_and_torch_draw_the_same_candidates() -> None:
    drawn = [
        search.propose(_belief(), 0, torch.Generator().manual_seed(3))
        for search in (KernelCrossEntropy(CONFIG), CrossEntropy(CONFIG))
    ]
    assert drawn[0].equal(drawn[1])


@pytest.mark.parametrize("usable", [60, 7, 3, 1, 0])
def test_kernel_update_agrees_with_few_finite_values(usable: int) -> None:
    values = _values()
    values[:, usable:] = -torch.inf
    found, expected = _learned(values)
    count = min(usable, CONFIG.elites)
    assert found.values.equal(expected.values)
    assert found.elites[:, :count].equal(expected.elites[:, :count])  # of equals any may come next
    for name in ("mean", "std", "value"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name))


def test_kernel_update_does_not_depend_on_other_robots() -> None:
    values = _values()
    both, _ = _learned(values)
    values[1] = -torch.inf
    beside, _ = _learned(values)
    assert both.mean[0].equal(beside.mean[0])
    assert both.std[0].equal(beside.std[0])


@pytest.mark.parametrize("size", [spec.ACTION_DIM, 19])
def test_kernel_random_walk_is_bit_identical(size: int) -> None:
    rng = torch.Generator().manual_seed(4)
    start = 2 * torch.rand(3, 1, size, generator=rng) - 1
    deltas = 2 * torch.rand(3, 50, 4, size, generator=rng) - 1
    deltas[1, 2, 3, 4] = torch.nan
    found = KernelCrossEntropy(CONFIG).random_walk(start, deltas, 0.9)
    torch.testing.assert_close(
        found, random_walk(start, deltas, 0.9), rtol=0, atol=0, equal_nan=True
    )


def test_other_devices_and_backends_use_torch() -> None:
    assert isinstance(optimiser_of(CONFIG, "cuda"), CrossEntropy)
    assert isinstance(optimiser_of(PlannerConfig(backend="float32")), CrossEntropy)
