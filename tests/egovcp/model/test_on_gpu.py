"""A gradient step on a GPU is the one of the processor."""

import dataclasses

import pytest
import torch
from torch import Tensor

from egovcp.model import Batch, StepNoise, WorldModel, sample_step_noise, world_model_gradients
from egovcp.testing import random_batch, toy_model

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]


def _step(model: WorldModel, batch: Batch, draws: StepNoise) -> tuple[dict[str, float], Tensor]:
    total, terms, _ = world_model_gradients(model, batch, draws)
    gradients = [p.grad.flatten().cpu() for p in model.parameters() if p.grad is not None]
    named = {name: float(term) for name, term in {**terms, "total": total}.items()}
    return named, torch.cat(gradients)


@pytest.mark.parametrize("preset", ["debug", "default", "paper"])
def test_losses_and_gradients_are_those_of_the_cpu(
    preset: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    model = toy_model(preset).train()
    every = dataclasses.replace(model.config.loss, decode_every=1, multistep_stride=1)
    model.config = dataclasses.replace(model.config, loss=every)
    batch = random_batch(4, 16)
    draws = sample_step_noise(model, batch)
    expected, gradient = _step(model, batch, draws)
    draws = draws._replace(latent=draws.latent.cuda(), actions=draws.actions.cuda())
    found, on_gpu = _step(model.cuda(), Batch(*(x.cuda() for x in batch)), draws)
    assert found == pytest.approx(expected, rel=1e-3, abs=1e-4)
    assert on_gpu.shape == gradient.shape
    assert (on_gpu - gradient).norm() < 1e-3 * gradient.norm()
