"""The pixels of a thing whose place in the picture is known."""

import torch

from egovcp.model.depth import highest_3x3, lowest_3x3, thing_pixels


def test_they_are_near_its_place_and_at_its_depth() -> None:
    near = torch.zeros(1, 48, 64)
    near[0, 10:14, 10:14] = 0.6  # 2 m of 5
    near[0, 30:34, 30:34] = 0.6  # the same elsewhere
    near[0, 12, 12] = 0.9  # something before it
    found = thing_pixels(near, torch.tensor([[11.5, 11.5, 3.0, 2.05]]), 5.0)[0]
    assert found[10:14, 10:14].sum() == 15
    assert found.sum() == 15


def test_what_is_nowhere_has_none() -> None:
    near = torch.full((1, 48, 64), 0.6)
    assert not thing_pixels(near, torch.tensor([[20.0, 20.0, 0.0, 2.0]]), 5.0).any()


def test_extremes_of_the_neighbourhood() -> None:
    x = torch.rand(2, 5, 6, generator=torch.Generator().manual_seed(0))
    pooled = torch.nn.functional.max_pool2d(x, 3, stride=1, padding=1)
    assert torch.equal(highest_3x3(x), pooled)
    assert torch.equal(lowest_3x3(x), -torch.nn.functional.max_pool2d(-x, 3, stride=1, padding=1))
