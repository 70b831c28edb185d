"""Held-out metrics: each says what its name says, on models whose answer is known."""

import pytest
import torch
from torch import Tensor

from egovcp.model import PRESETS, Batch, Carry, WorldModel
from egovcp.testing import random_batch, toy_model
from egovcp_train.evaluation import evaluate


class _Oracle(WorldModel):
    """Q is ``scale`` times the action's first coordinate plus ``offset``."""

    scale, offset = 1.0, 0.0

    def value(self, carry: Carry, action: Tensor) -> Tensor:
        return self.scale * action[..., 0] + self.offset


def _batches(count: int = 3) -> list[Batch]:
    """Returns that are the action's first coordinate."""
    batches = [random_batch(3, 16, seed) for seed in range(count)]
    return [batch._replace(mc_return=batch.action[..., 0].clone()) for batch in batches]


def _oracle(scale: float = 1.0, offset: float = 0.0) -> WorldModel:
    model = _Oracle(PRESETS["debug"])
    model.scale, model.offset = scale, offset
    return model


def test_a_perfect_value_explains_everything() -> None:
    metrics = evaluate(_oracle(), _batches())
    assert metrics["value/r2"] == pytest.approx(1.0)
    assert metrics["value/slope"] == pytest.approx(1.0)


def test_a_timid_value_has_a_steep_slope() -> None:
    metrics = evaluate(_oracle(scale=0.5), _batches())
    assert metrics["value/slope"] == pytest.approx(2.0)
    assert metrics["value/r2"] == pytest.approx(0.75, abs=0.01)


def test_a_constant_value_explains_nothing() -> None:
    metrics = evaluate(_oracle(scale=0.0), _batches())
    assert metrics["value/r2"] == pytest.approx(0.0, abs=0.02)


def test_rows_that_do_not_count_are_left_out() -> None:
    def spoil(batch: Batch, name: str) -> Batch:
        mask, returns = getattr(batch, name).clone(), batch.mc_return.clone()
        mask[:, 10:] = False
        returns[:, 10:] = 100.0
        return batch._replace(**{name: mask}, mc_return=returns)

    for name in ("valid", "mc_valid"):
        metrics = evaluate(_oracle(), [spoil(batch, name) for batch in _batches()])
        assert metrics["value/r2"] == pytest.approx(1.0), name


def test_evaluating_repeats_and_changes_neither_model_nor_random_stream() -> None:
    model, batches = toy_model(), _batches()
    weights = {k: v.clone() for k, v in model.state_dict().items()}
    stream = torch.random.get_rng_state()
    assert evaluate(model, batches) == evaluate(model, batches)
    assert torch.equal(stream, torch.random.get_rng_state())
    assert all(torch.equal(weights[k], v) for k, v in model.state_dict().items())


def test_windows_too_short_to_look_ahead_are_no_error() -> None:
    metrics = evaluate(toy_model(), [random_batch(2, 5)])
    assert {"value/r2", "latent/kl", "latent/active"} <= metrics.keys()
    assert 0 <= metrics["latent/active"] <= PRESETS["debug"].latent
