"""The kernel's cross-entropy method does what the torch one says."""

import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.plan import PlannerConfig, optimiser_of
from egovcp.plan.backends import library
from egovcp.plan.optimisers import CrossEntropy, KernelCrossEntropy
from egovcp.plan.search import SearchState, random_walk

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


def test_it_draws_the_same_from_the_same_seed() -> None:
    drawn = [
        search.propose(_belief(), 0, torch.Generator().manual_seed(3))
        for search in (KernelCrossEntropy(CONFIG), CrossEntropy(CONFIG))
    ]
    assert drawn[0].equal(drawn[1])


@pytest.mark.parametrize("usable", [60, 7, 3, 1, 0])
def test_it_learns_the_same_also_where_few_plans_are_worth_anything(usable: int) -> None:
    values = _values()
    values[:, usable:] = -torch.inf
    found, expected = _learned(values)
    count = min(usable, CONFIG.elites)
    assert found.values.equal(expected.values)
    assert found.elites[:, :count].equal(expected.elites[:, :count])  # of equals any may come next
    for name in ("mean", "std", "value"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name))


def test_a_robot_learns_the_same_beside_one_whose_plans_are_worth_nothing() -> None:
    values = _values()
    both, _ = _learned(values)
    values[1] = -torch.inf
    beside, _ = _learned(values)
    assert both.mean[0].equal(beside.mean[0])
    assert both.std[0].equal(beside.std[0])


@pytest.mark.parametrize("size", [spec.ACTION_DIM, 19])
def test_its_walks_are_the_process_to_the_bit(size: int) -> None:
    rng = torch.Generator().manual_seed(4)
    start = 2 * torch.rand(3, 1, size, generator=rng) - 1
    deltas = 2 * torch.rand(3, 50, 4, size, generator=rng) - 1
    deltas[1, 2, 3, 4] = torch.nan
    found = KernelCrossEntropy(CONFIG).random_walk(start, deltas, 0.9)
    torch.testing.assert_close(
        found, random_walk(start, deltas, 0.9), rtol=0, atol=0, equal_nan=True
    )


def test_what_is_not_on_the_processor_or_not_for_the_kernel_is_left_to_torch() -> None:
    assert isinstance(optimiser_of(CONFIG, "cuda"), CrossEntropy)
    assert isinstance(optimiser_of(PlannerConfig(backend="float32")), CrossEntropy)
