"""The recurrence and its gradient by hand, against the modules and autograd."""

import pytest
import torch
from torch import Tensor

from egovcp.model import Batch, Carry, WorldModel
from egovcp.model.recurrence import Filtered, filter_embeddings, filter_steps
from egovcp.testing import random_batch, toy_model

BATCH, LENGTH = 3, 7


@pytest.fixture
def uneven() -> WorldModel:
    """With norms that are not the identity."""
    model = toy_model()
    for parameter in model.parameters():
        if parameter.ndim == 1:
            torch.nn.init.normal_(parameter, std=0.5)
    return model


@pytest.fixture
def sequence() -> Batch:
    batch = random_batch(BATCH, LENGTH)
    batch.is_first[0, 0] = False  # goes on from the carry
    batch.is_first[1, 4] = True
    return batch


def _inputs(model: WorldModel, batch: Batch) -> tuple[Tensor, Tensor, Tensor, Carry]:
    c = model.config
    embedding = torch.randn(BATCH, LENGTH, c.units)
    carry = Carry(*(torch.randn(BATCH, n) for n in (c.hidden, c.latent)))
    leaves = embedding, batch.prev_action, *carry
    embedding, action, h, z = (x.requires_grad_() for x in leaves)
    return embedding, action, batch.is_first, Carry(h, z)


def _weighted(found: Filtered) -> Tensor:
    """A sum in which every number has a weight of its own."""
    generator = torch.Generator().manual_seed(1)
    parts = [x for pair in found for x in pair]
    weights = (torch.randn(x.shape, generator=generator, dtype=x.dtype) for x in parts)
    return torch.stack([(x * w).sum() for x, w in zip(parts, weights, strict=True)]).sum()


@pytest.mark.parametrize("sample", [True, False])
def test_states_and_gradients_are_those_of_the_modules(
    uneven: WorldModel, sequence: Batch, sample: bool
) -> None:
    inputs = _inputs(uneven, sequence)
    noise = torch.randn(LENGTH, BATCH, uneven.config.latent) if sample else None
    one, two = (run(uneven, *inputs, noise) for run in (filter_embeddings, filter_steps))
    for a, b in zip(one.carry + one.posterior, two.carry + two.posterior, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
    embedding, action, _, carry = inputs
    modules = uneven.mix, uneven.mix_act, uneven.gru, uneven.posterior
    wanted = [embedding, action, *carry, *(p for m in modules for p in m.parameters())]
    found, expected = (torch.autograd.grad(_weighted(x), wanted) for x in (one, two))
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
        assert b.abs().max() > 0


def test_what_is_not_a_number_stays_in_its_episode(uneven: WorldModel, sequence: Batch) -> None:
    embedding, action, is_first, carry = _inputs(uneven, sequence)
    bad = embedding.detach().clone()
    bad[1, 3] = torch.nan
    found = filter_embeddings(uneven, bad, action, is_first, carry, None)
    assert found.carry.z[1, 3].isnan().all()
    assert found.carry.features[1, 4:].isfinite().all()
    assert found.carry.features[[0, 2]].isfinite().all()
