"""The pixels of a thing whose place in the picture is known."""

import torch

from egovcp.model.depth import highest_3x3, lowest_3x3, paint_disc, thing_pixels


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


def test_a_disc_is_painted_where_it_is_said_to_be() -> None:
    """At half width right of the middle and a quarter height above it, 2 m away."""
    place = torch.tensor([[0.5, -0.25, 0.6, 9.0], [0.5, -0.25, 0.6, -9.0]])
    sharp = torch.tensor([[0.0, -9.0]] * 2)
    image = paint_disc(torch.full((2, 48, 64), 0.2), place, sharp, 5.0)
    rows, cols = torch.nonzero(image[0] > 0.4, as_tuple=True)
    assert abs(rows.float().mean() - 17.6) < 0.5
    assert abs(cols.float().mean() - 47.25) < 0.5
    assert abs(len(rows) - torch.pi * 2.5**2) < 5
    assert torch.allclose(image[0, 18, 47], torch.tensor(0.6), atol=0.01)
    assert torch.equal(image[1], torch.full((48, 64), 0.2))


def test_the_place_of_a_disc_can_be_learned_from_the_picture() -> None:
    sharp = torch.tensor([[0.0, 1.0]])
    empty = torch.zeros(1, 48, 64)
    target = paint_disc(empty, torch.tensor([[0.1, 0.1, 0.6, 9.0]]), sharp, 5.0)
    place = torch.tensor([[0.05, 0.16, 0.5, 1.0]], requires_grad=True)
    optimizer = torch.optim.Adam([place], lr=0.01)
    for _ in range(300):
        optimizer.zero_grad()
        (paint_disc(empty, place, sharp, 5.0) - target).square().sum().backward()
        optimizer.step()
    torch.testing.assert_close(place[0, :2], torch.tensor([0.1, 0.1]), atol=0.01, rtol=0)
    assert abs(float(place[0, 2].detach()) - 0.6) < 0.05  # paler and surer look alike
