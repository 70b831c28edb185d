"""Which predictions are shown, and that the pictures show them."""

import numpy as np
import pytest
import torch

from egovcp import spec
from egovcp.model import Batch, Carry
from egovcp.model.losses import filter_sequence
from egovcp.testing import random_batch, toy_model
from egovcp_train.heldout.episodes import Recorded
from egovcp_train.heldout.open_loop import CONTEXT, HORIZONS
from egovcp_train.heldout.pictures import calibration_picture, strip_picture
from egovcp_train.heldout.report import Values
from egovcp_train.heldout.strips import KEPT, STRIP, Strip, best, strips


def _strips(batch: Batch) -> list[Strip]:
    model = toy_model()
    with torch.no_grad():
        rollout = filter_sequence(model, batch, sample=False)
        return strips(model, Recorded("ball", batch), rollout)


def _still(length: int = 40) -> Batch:
    batch = random_batch(5, length)
    return batch._replace(depth=torch.full_like(batch.depth, 2000))


def test_a_strip_starts_before_what_moves() -> None:
    batch = _still()
    batch.depth[3, 25:28] = 1000  # a change into row 25, and one into row 28
    (first, *_) = _strips(batch)
    assert max(CONTEXT - 1, 28 - max(HORIZONS)) <= first.start < 25
    seen = first.seen[[k + first.start in (25, 26, 27) for k in STRIP]]
    assert len(seen) > 0
    assert np.allclose(seen, 0.8)
    assert first.foreseen.shape == (len(STRIP), spec.DEPTH_ROWS, spec.DEPTH_COLS)


def test_the_first_picture_is_filtered_and_the_others_are_imagined() -> None:
    batch = random_batch(1, 30)
    model = toy_model()
    with torch.no_grad():
        rollout = filter_sequence(model, batch, sample=False)
        (found,) = _strips(batch)
        s = found.start
        carry = Carry(rollout.carry.h[:, s], rollout.carry.z[:, s])
        filtered = model.decode_near(carry)[0].clamp(0, 1)
        carry = model.imagine(carry, batch.action[:, s])
        carry = model.imagine(carry, batch.action[:, s + 1])
        ahead = model.decode_near(carry)[0].clamp(0, 1)
    torch.testing.assert_close(torch.from_numpy(found.foreseen[0]), filtered)
    torch.testing.assert_close(torch.from_numpy(found.foreseen[1]), ahead)


@pytest.mark.parametrize("length", [2, 15, 16, 17])
def test_episodes_too_short_for_a_strip_have_none(length: int) -> None:
    assert _strips(_still(length)) == []


def test_few_strips_are_kept() -> None:
    found = best([s._replace(interest=i) for i, s in enumerate(_strips(_still()) * 3)])
    assert [s.interest for s in found] == [8, 7, 6]
    assert len(found) == KEPT


def test_pictures_show_their_content() -> None:
    (found,) = _strips(random_batch(1, 30))
    plain = [found._replace(foreseen=np.full_like(found.foreseen, x)) for x in (0.0, 1.0)]
    pictures = [strip_picture([strip]) for strip in plain]
    assert pictures[0].dtype == np.uint8
    assert pictures[0].shape == (*pictures[1].shape[:2], 3)
    assert (pictures[0] != pictures[1]).any(-1).mean() > 0.2
    values = Values(torch.randn(50), torch.randn(50))
    some = calibration_picture(values, {"slope": 1.0, "r2": 0.5, "bias": 0.0})
    flat = calibration_picture(values, {"slope": None, "r2": 0.5, "bias": 0.0})
    assert (some != flat).any()
