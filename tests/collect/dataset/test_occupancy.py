"""How full and how even the action box is."""

import numpy as np
import pytest

from egovcp.spec import ACTION_BOX, ACTION_NAMES, reflect
from egovcp_collect.dataset.occupancy import BINS, CELLS, Occupancy


def actions(n: int = 100_000) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (n, 7)).astype(np.float32)


def test_uniform_actions_fill_the_box_evenly() -> None:
    found = Occupancy.of(actions())
    assert min(found.uniformity.values()) > 0.98
    assert set(found.occupied.values()) == {1.0}


def test_a_single_action_is_one_bin_and_one_cell() -> None:
    found = Occupancy.of(np.zeros((50, 7), np.float32))
    assert [*found.uniformity.values()] == pytest.approx([1 / BINS] * 7)
    assert set(found.occupied.values()) == {1 / CELLS**3}


def test_every_action_is_counted_even_on_the_walls_of_the_box() -> None:
    edge = np.array([[-1.0] * 7, [1.0] * 7, [0.0] * 7], np.float32)
    found = Occupancy.of(edge)
    for counts in found.histogram.values():
        assert len(counts) == BINS
        assert sum(counts) == 3
    for i, name in enumerate(ACTION_NAMES):
        assert found.workspace_m[name] == pytest.approx((ACTION_BOX.low[i], ACTION_BOX.high[i]))


def test_a_clipped_walk_is_less_even_than_a_reflected_one() -> None:
    steps = np.random.default_rng(1).uniform(-0.32, 0.32, (40_000, 7))
    clipped, reflected = np.zeros((2, len(steps), 7))
    for t in range(1, len(steps)):
        clipped[t] = np.clip(clipped[t - 1] + steps[t], -1, 1)
        reflected[t] = reflect(reflected[t - 1] + steps[t])
    least = {
        name: min(Occupancy.of(walk).uniformity.values())
        for name, walk in (("clipped", clipped), ("reflected", reflected))
    }
    assert least["clipped"] + 0.05 < least["reflected"]
    assert least["reflected"] > 0.95


def test_hands_are_told_apart() -> None:
    moved = np.zeros((10_000, 7))
    moved[:, :3] = actions(10_000)[:, :3]
    found = Occupancy.of(moved)
    assert found.occupied["left"] > 0.9
    assert found.occupied["right"] == 1 / CELLS**3
