"""Open-loop errors of models whose prediction is known, image strips and pictures."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.model import PRESETS, Batch, Carry, WorldModel
from egovcp.model.depth import nearness
from egovcp.model.losses import filter_sequence
from egovcp.testing import random_batch, toy_model
from egovcp_train.heldout.open_loop import (
    CONTEXT,
    HORIZONS,
    MAX_STRIPS,
    REGIONS,
    STRIP_HORIZONS,
    ImageStrip,
    OpenLoop,
    _regions,
    image_strips,
    select_strips,
)
from egovcp_train.heldout.pictures import calibration_picture, strip_picture
from egovcp_train.heldout.report import Values

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


def _episodes() -> Batch:
    """Two episodes, one cut short."""
    batch = random_batch(2, LENGTH)
    valid = batch.valid.clone()
    valid[1, 20:] = False
    return batch._replace(valid=valid)


def _errors(model: WorldModel, episodes: Batch, stride: int = 1) -> OpenLoop:
    found = OpenLoop(stride)
    with torch.no_grad():
        found.add(model, episodes, filter_sequence(model, episodes))
    return found


def _flat(errors: dict[str, dict[str, dict[str, Any]]]) -> list[dict[str, Any]]:
    return [cell for horizons in errors.values() for cell in horizons.values()]


def test_a_perfect_model_makes_no_error_and_repeating_does() -> None:
    episodes = _episodes()
    found = _errors(_Clairvoyant(episodes, repeats=False), episodes)
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
    found = _errors(_Clairvoyant(episodes, repeats=True), episodes)
    for cell in _flat(found.depth()):
        if cell["pixels"]:
            assert cell["model_mm"] == pytest.approx(cell["repeat_mm"])
    for cell in _flat(found.state()):
        assert cell["model"] == pytest.approx(cell["repeat"])


def test_every_start_after_the_context_and_every_row_ahead_counts_once() -> None:
    episodes = _episodes()
    found = _errors(_Clairvoyant(episodes, repeats=False), episodes)
    for k in HORIZONS:
        starts = sum(max(0, length - k - (CONTEXT - 1)) for length in (LENGTH, 20))
        assert found.state()["joint_position"][str(k)]["rows"] == starts
        assert found.depth()["valid"][str(k)]["pixels"] > 0
    sparse = _errors(_Clairvoyant(episodes, repeats=False), episodes, stride=5)
    assert sparse.state()["joint_position"]["1"]["rows"] == 6 + 4


def test_the_error_is_in_millimetres_and_nothing_in_range_is_the_end_of_it() -> None:
    episodes = _episodes()
    depth = torch.full_like(episodes.depth, 1000)
    depth[..., :10] = 0
    episodes = episodes._replace(depth=depth)
    blind = _Clairvoyant(episodes, repeats=False)
    blind.near = torch.zeros_like(blind.near)
    found = _errors(blind, episodes).depth()
    assert found["valid"]["4"]["model_mm"] == pytest.approx(MAX_MM - 1000, rel=1e-4)
    assert found["near"]["4"]["model_mm"] == pytest.approx(MAX_MM - 1000, rel=1e-4)
    assert found["valid"]["4"]["repeat_mm"] == pytest.approx(0.0, abs=1e-3)
    assert found["moving"]["4"]["model_mm"] is None


def test_nothing_in_range_of_a_short_camera_is_not_near() -> None:
    near = torch.zeros(1, 2, 48, 64)
    near[..., 0] = 0.1
    assert _regions(near, max_m=1.0)["near"].equal(near > 0)


def test_a_moving_block_is_moving() -> None:
    """A block 1 m away, before nothing, moves by its own width: what it covers was empty."""
    episodes = _episodes()
    depth = torch.zeros_like(episodes.depth)
    for t in range(20):
        depth[:, t, 10:20, 3 * t : 3 * t + 3] = 1000
    episodes = episodes._replace(depth=depth)
    found = _errors(_Clairvoyant(episodes, repeats=False), episodes).depth()
    for k in HORIZONS:
        assert found["moving"][str(k)]["repeat_mm"] == pytest.approx(MAX_MM - 1000, rel=1e-4)


def test_the_recorded_actions_are_imagined() -> None:
    episodes = _episodes()
    model = _Clairvoyant(episodes, repeats=False)
    _errors(model, episodes, stride=7)
    starts = torch.arange(CONTEXT - 1, LENGTH - 1, 7)
    for k, action in enumerate(model.actions[:4]):
        torch.testing.assert_close(action, episodes.action[:, (starts + k).clamp_max(29)])


def test_an_episode_shorter_than_the_context_is_no_error() -> None:
    batch = random_batch(1, CONTEXT - 1)
    found = _errors(_Clairvoyant(batch, repeats=False), batch)
    assert all(cell["model"] is None and cell["rows"] == 0 for cell in _flat(found.state()))


def test_groups_add_up() -> None:
    episodes = _episodes()
    model = _Clairvoyant(episodes, repeats=True)
    once, twice = _errors(model, episodes), _errors(model, episodes)
    with torch.no_grad():
        twice.add(model, episodes, filter_sequence(model, episodes))
    for a, b in zip(_flat(once.depth()), _flat(twice.depth()), strict=True):
        assert b["pixels"] == 2 * a["pixels"]
        assert b["model_mm"] == pytest.approx(a["model_mm"])


# --- image strips --------------------------------------------------------------------
def _strips(batch: Batch) -> list[ImageStrip]:
    model = toy_model()
    with torch.no_grad():
        rollout = filter_sequence(model, batch)
        return image_strips(model, batch, rollout)


def _still(length: int = 40) -> Batch:
    batch = random_batch(5, length)
    return batch._replace(depth=torch.full_like(batch.depth, 2000))


def test_a_strip_starts_before_what_moves() -> None:
    batch = _still()
    batch.depth[3, 25:28] = 1000  # a change into row 25, and one into row 28
    (first, *_) = _strips(batch)
    assert max(CONTEXT - 1, 28 - max(HORIZONS)) <= first.start < 25
    seen = first.observed[[k + first.start in (25, 26, 27) for k in STRIP_HORIZONS]]
    assert len(seen) > 0
    assert np.allclose(seen, 0.8)
    assert first.predicted.shape == (len(STRIP_HORIZONS), spec.DEPTH_ROWS, spec.DEPTH_COLS)


def test_the_first_picture_is_filtered_and_the_others_are_imagined() -> None:
    batch = random_batch(1, 30)
    model = toy_model()
    with torch.no_grad():
        rollout = filter_sequence(model, batch)
        (found,) = _strips(batch)
        s = found.start
        carry = Carry(rollout.carry.h[:, s], rollout.carry.z[:, s])
        filtered = model.decode_near(carry)[0].clamp(0, 1)
        carry = model.imagine(carry, batch.action[:, s])
        carry = model.imagine(carry, batch.action[:, s + 1])
        ahead = model.decode_near(carry)[0].clamp(0, 1)
    torch.testing.assert_close(torch.from_numpy(found.predicted[0]), filtered)
    torch.testing.assert_close(torch.from_numpy(found.predicted[1]), ahead)


@pytest.mark.parametrize("length", [2, 15, 16, 17])
def test_episodes_too_short_for_a_strip_have_none(length: int) -> None:
    assert _strips(_still(length)) == []


def test_few_strips_are_kept() -> None:
    many = [s._replace(moving_pixels=i) for i, s in enumerate(_strips(_still()) * 3)]
    found = select_strips(many)
    assert [s.moving_pixels for s in found] == [8, 7, 6]
    assert len(found) == MAX_STRIPS


def test_pictures_show_their_content() -> None:
    (found,) = _strips(random_batch(1, 30))
    plain = [found._replace(predicted=np.full_like(found.predicted, x)) for x in (0.0, 1.0)]
    pictures = [strip_picture([strip]) for strip in plain]
    assert pictures[0].dtype == np.uint8
    assert pictures[0].shape == (*pictures[1].shape[:2], 3)
    assert (pictures[0] != pictures[1]).any(-1).mean() > 0.2
    slow = strip_picture([plain[0]], planner_hz=10)  # other times below the images
    assert slow.shape != pictures[0].shape or (slow != pictures[0]).any()
    values = Values(torch.randn(50, 1), torch.randn(50, 1))
    some = calibration_picture(values, {"slope": 1.0, "r2": 0.5, "bias": 0.0})
    flat = calibration_picture(values, {"slope": None, "r2": 0.5, "bias": 0.0})
    assert (some != flat).any()
