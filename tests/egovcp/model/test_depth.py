import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.model.depth import extreme_3x3, nearness, network_image, to_metres

MAX_M = spec.DEPTH_MAX_M
SHAPE = (1, spec.DEPTH_ROWS, spec.DEPTH_COLS)


def _raw(depth_mm: Tensor) -> Tensor:
    """Nearness of each pixel by itself, by definition."""
    near = (1 - depth_mm.double() / 1000 / MAX_M).clamp(0, 1)
    return torch.where(depth_mm == 0, 0.0, near).float()


def _random_depth() -> Tensor:
    rng = torch.Generator().manual_seed(0)
    depth = torch.randint(280, 7000, SHAPE, generator=rng, dtype=torch.int32)
    return torch.where(torch.rand(SHAPE, generator=rng) < 0.1, 0, depth)


def test_a_flat_wall_has_the_nearness_of_its_distance() -> None:
    wall = torch.full(SHAPE, 2000, dtype=torch.int32)
    torch.testing.assert_close(nearness(wall, MAX_M), torch.full(SHAPE, 1 - 2 / MAX_M))


@pytest.mark.parametrize("hole", [(20, 30), (0, 0), (47, 63), (0, 31), (47, 5)])
def test_an_isolated_hole_in_a_wall_is_filled(hole: tuple[int, int]) -> None:
    wall = torch.full(SHAPE, 2000, dtype=torch.int32)
    damaged = wall.clone()
    damaged[0, *hole] = 0
    assert torch.equal(nearness(damaged, MAX_M), nearness(wall, MAX_M))


def test_a_large_hole_stays_open() -> None:
    wall = torch.full(SHAPE, 2000, dtype=torch.int32)
    wall[0, 10:20, 10:20] = 0
    assert nearness(wall, MAX_M)[0, 12:18, 12:18].max() == 0


@pytest.mark.parametrize("size", [1, 2, 3])
def test_a_small_near_object_keeps_its_place_size_and_nearness(size: int) -> None:
    depth = torch.zeros(SHAPE, dtype=torch.int32)
    depth[0, 20 : 20 + size, 40 : 40 + size] = 1000
    assert torch.equal(nearness(depth, MAX_M), _raw(depth))


def test_filling_only_brings_nearer_and_filling_again_changes_nothing() -> None:
    near = nearness(_random_depth(), MAX_M)
    assert (near >= _raw(_random_depth()) - 1e-6).all()
    assert near.min() >= 0
    assert near.max() <= 1
    again = nearness(((1 - near) * MAX_M * 1000).round().int(), MAX_M)
    torch.testing.assert_close(again, near, atol=2e-4, rtol=0)


def test_each_image_of_a_batch_is_treated_alone() -> None:
    one, two = _random_depth(), _random_depth().flip(1)
    both = nearness(torch.cat([one, two]), MAX_M)
    assert torch.equal(both[:1], nearness(one, MAX_M))
    assert torch.equal(both[1:], nearness(two, MAX_M))


def test_depth_beyond_the_range_has_nearness_0() -> None:
    far = torch.full(SHAPE, round(1000 * MAX_M) + 500, dtype=torch.int32)
    assert nearness(far, MAX_M).max() == 0
    assert network_image(nearness(far, MAX_M)).max() == 0


def test_to_metres_inverts_nearness() -> None:
    wall = torch.full(SHAPE, 1234, dtype=torch.int32)
    torch.testing.assert_close(to_metres(nearness(wall, MAX_M), MAX_M), wall / 1000)
    assert to_metres(torch.zeros(SHAPE), MAX_M).max() == 0


def test_network_image_has_nearness_and_validity_channels() -> None:
    depth = torch.zeros(SHAPE, dtype=torch.int32)
    depth[0, 5:9, 5:9] = 3000
    near, valid = network_image(nearness(depth, MAX_M))[0]
    assert torch.equal(valid.bool(), depth[0] > 0)
    assert torch.equal(near > 0, depth[0] > 0)


def test_extremes_of_a_neighbourhood_are_those_of_max_pooling() -> None:
    x = torch.rand(2, 5, 6, generator=torch.Generator().manual_seed(0))
    high, low = (torch.nn.functional.max_pool2d(y, 3, stride=1, padding=1) for y in (x, -x))
    assert torch.equal(extreme_3x3(x, torch.maximum), high)
    assert torch.equal(extreme_3x3(x, torch.minimum), -low)
