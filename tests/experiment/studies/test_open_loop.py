"""Open-loop images of an untrained policy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from egovcp.model import Carry
from egovcp_experiment.cell import read_json
from egovcp_experiment.studies import open_loop


def test_images_start_at_the_filtered_state(flags: list[str], tmp_path: Path) -> None:
    assert open_loop.main([*flags, "--task=wall"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert found["episodes"] == 2
    for strip in found["strips"]:
        assert np.shape(strip["seen"]) == (len(open_loop.HORIZONS), 48, 64)
        assert np.shape(strip["imagined"]) == np.shape(strip["seen"])
    assert found["errors_m"]["0"]["repeat"] == 0.0
    assert found["errors_m"]["8"]["model"] > 0.0


def test_empty_predictions_count_as_the_end_of_the_range() -> None:
    """Pixels: empty and rightly so, wrongly predicted as empty, moved before nothing, moved."""
    model = np.array([[[0.0, 0.0, 4.0, 1.0]]])
    truth = np.array([[[0.0, 4.5, 4.0, 2.0]]])
    last = np.array([[[3.0, 4.5, 0.0, 1.0]]])
    assert open_loop._errors(model, truth, last, max_m=5.0) == {
        "model": pytest.approx((0.5 + 0 + 1) / 3),
        "repeat": pytest.approx((0 + 1 + 1) / 3),
        "model_changed": pytest.approx((0 + 1) / 2),
        "repeat_changed": pytest.approx((1 + 1) / 2),
    }


def test_imagination_follows_the_actions_that_were_sent() -> None:
    """A model that counts: its picture k ticks ahead is the sum of the k actions sent."""

    class Counter:
        def decode(self, carry: Carry) -> tuple[torch.Tensor, None]:
            return carry.h.expand(1, 1, 1), None

        def imagine(self, carry: Carry, action: torch.Tensor) -> Carry:
            return Carry(carry.h + action[:, :1], carry.z)

    clip = open_loop._Clip(Carry(torch.zeros(1, 1), torch.zeros(1, 1)))
    clip.sent = [np.full(7, float(k)) for k in range(16)]
    imagined = open_loop._imagine(Counter(), clip)  # type: ignore[arg-type]
    assert imagined[:, 0, 0].tolist() == [sum(range(k)) for k in open_loop.HORIZONS]
