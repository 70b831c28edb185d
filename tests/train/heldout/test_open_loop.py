"""Errors of models whose prediction is known."""

from typing import Any

import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.model import PRESETS, Batch, Carry, WorldModel
from egovcp.model.depth import nearness
from egovcp.model.losses import filter_sequence
from egovcp.testing import random_batch
from egovcp_train.heldout.episodes import Recorded
from egovcp_train.heldout.open_loop import CONTEXT, HORIZONS, REGIONS, OpenLoop

LENGTH = 30
MAX_MM = 1e3 * spec.DEPTH_MAX_M


class _Clairvoyant(WorldModel):
    """Knows the recording: h holds the episode, the tick, and the tick of the last frame.

    It answers with the recorded row at the tick, or at the last frame if it ``repeats``.
    """

    def __init__(self, batch: Batch, repeats: bool) -> None:
        super().__init__(PRESETS["debug"])
        self.near = nearness(batch.depth.flatten(0, 1), self.config.depth_max_m)
        self.near = self.near.view(*batch.depth.shape)
        self.known = self.standardise(batch.state)
        self.index = 2 if repeats else 1
        self.actions: list[Tensor] = []
        self.decode_depth.forward = lambda x: self.near[self._place(x)]  # type: ignore
        self.decode_state.forward = lambda h, z: self.known[self._place(h)]  # type: ignore

    def _place(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return x[:, 0].long(), x[:, self.index].long()

    def advance(self, carry: Carry, action: Tensor, is_first: Tensor) -> Tensor:
        h = torch.zeros_like(carry.h)
        h[:, 0] = torch.arange(len(h))
        h[:, 1:3] = torch.where(is_first[:, None], 0.0, carry.h[:, 1:3] + 1.0)
        return h

    def imagine(self, carry: Carry, action: Tensor) -> Carry:
        self.actions.append(action)
        h = carry.h.clone()
        h[..., 1] += 1.0
        return Carry(h, carry.z)


def _episodes() -> Recorded:
    """Two episodes, one cut short."""
    batch = random_batch(2, LENGTH)
    valid = batch.valid.clone()
    valid[1, 20:] = False
    return Recorded("ball", batch._replace(valid=valid))


def _errors(model: WorldModel, episodes: Recorded, stride: int = 1) -> OpenLoop:
    found = OpenLoop(stride)
    with torch.no_grad():
        found.add(model, episodes, filter_sequence(model, episodes.batch, sample=False))
    return found


def _flat(errors: dict[str, dict[str, dict[str, Any]]]) -> list[dict[str, Any]]:
    return [cell for horizons in errors.values() for cell in horizons.values()]


def test_a_perfect_model_makes_no_error_and_repeating_does() -> None:
    episodes = _episodes()
    found = _errors(_Clairvoyant(episodes.batch, repeats=False), episodes)
    assert set(found.depth()) == set(REGIONS)
    for cell in _flat(found.depth()):
        if cell["pixels"]:
            assert cell["model_mm"] == pytest.approx(0.0, abs=1e-2)
            assert cell["repeat_mm"] > 100
    for cell in _flat(found.state()):
        assert cell["model"] == pytest.approx(0.0, abs=1e-6)
        assert cell["repeat"] > 0.5


def test_a_model_that_stands_still_is_the_repeated_image() -> None:
    episodes = _episodes()
    found = _errors(_Clairvoyant(episodes.batch, repeats=True), episodes)
    for cell in _flat(found.depth()):
        if cell["pixels"]:
            assert cell["model_mm"] == pytest.approx(cell["repeat_mm"])
    for cell in _flat(found.state()):
        assert cell["model"] == pytest.approx(cell["repeat"])


def test_every_start_after_the_context_and_every_row_ahead_counts_once() -> None:
    episodes = _episodes()
    found = _errors(_Clairvoyant(episodes.batch, repeats=False), episodes)
    for k in HORIZONS:
        starts = sum(max(0, length - k - (CONTEXT - 1)) for length in (LENGTH, 20))
        assert found.state()["joint_position"][str(k)]["rows"] == starts
        assert found.depth()["valid"][str(k)]["pixels"] > 0
    sparse = _errors(_Clairvoyant(episodes.batch, repeats=False), episodes, stride=5)
    assert sparse.state()["joint_position"]["1"]["rows"] == 6 + 4


def test_the_error_is_in_millimetres_and_nothing_in_range_is_the_end_of_it() -> None:
    episodes = _episodes()
    depth = torch.full_like(episodes.batch.depth, 1000)
    depth[..., :10] = 0
    episodes = episodes._replace(batch=episodes.batch._replace(depth=depth))
    blind = _Clairvoyant(episodes.batch, repeats=False)
    blind.near = torch.zeros_like(blind.near)
    found = _errors(blind, episodes).depth()
    assert found["valid"]["4"]["model_mm"] == pytest.approx(MAX_MM - 1000, rel=1e-4)
    assert found["near"]["4"]["model_mm"] == pytest.approx(MAX_MM - 1000, rel=1e-4)
    assert found["valid"]["4"]["repeat_mm"] == pytest.approx(0.0, abs=1e-3)
    assert found["moving"]["4"]["model_mm"] is None


def test_a_moving_block_is_moving() -> None:
    """A block 1 m away, before nothing, moves by its own width: what it covers was empty."""
    episodes = _episodes()
    depth = torch.zeros_like(episodes.batch.depth)
    for t in range(20):
        depth[:, t, 10:20, 3 * t : 3 * t + 3] = 1000
    episodes = episodes._replace(batch=episodes.batch._replace(depth=depth))
    found = _errors(_Clairvoyant(episodes.batch, repeats=False), episodes).depth()
    for k in HORIZONS:
        assert found["moving"][str(k)]["repeat_mm"] == pytest.approx(MAX_MM - 1000, rel=1e-4)


def test_the_recorded_actions_are_imagined() -> None:
    episodes = _episodes()
    model = _Clairvoyant(episodes.batch, repeats=False)
    _errors(model, episodes, stride=7)
    starts = torch.arange(CONTEXT - 1, LENGTH - 1, 7)
    for k, action in enumerate(model.actions[:4]):
        torch.testing.assert_close(action, episodes.batch.action[:, (starts + k).clamp_max(29)])


def test_an_episode_shorter_than_the_context_is_no_error() -> None:
    batch = random_batch(1, CONTEXT - 1)
    found = _errors(_Clairvoyant(batch, repeats=False), Recorded("ball", batch))
    assert all(cell["model"] is None and cell["rows"] == 0 for cell in _flat(found.state()))


def test_groups_add_up() -> None:
    episodes = _episodes()
    model = _Clairvoyant(episodes.batch, repeats=True)
    once, twice = _errors(model, episodes), _errors(model, episodes)
    with torch.no_grad():
        twice.add(model, episodes, filter_sequence(model, episodes.batch, sample=False))
    for a, b in zip(_flat(once.depth()), _flat(twice.depth()), strict=True):
        assert b["pixels"] == 2 * a["pixels"]
        assert b["model_mm"] == pytest.approx(a["model_mm"])
