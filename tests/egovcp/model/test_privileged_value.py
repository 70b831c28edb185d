"""The privileged value as the target of Q: of which actions, at which rows."""

import dataclasses

import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.model import (
    PRESETS,
    Batch,
    WorldModel,
    sample_step_noise,
    world_model_gradients,
    world_model_loss,
)
from egovcp.model.losses import filter_sequence
from egovcp.model.privileged_value import PrivilegedValue, sample_actions
from egovcp.model.value_losses import value_targets
from egovcp.testing import random_batch, toy_model

DEBUG = PRESETS["debug"]


def _value(batch: Batch, seed: int = 0) -> PrivilegedValue:
    torch.manual_seed(seed)
    value = PrivilegedValue(batch.privileged.shape[-1]).requires_grad_(False)
    torch.nn.init.normal_(value.network.rest[-1].weight)  # type: ignore[arg-type]
    return value


def _sampled(batch: Batch, count: int = 2) -> Tensor:
    return sample_actions(batch.prev_action, count, torch.Generator().manual_seed(0))


def test_sampled_actions_are_in_the_box_and_within_the_rate_limit() -> None:
    previous = torch.rand(20, 30, spec.ACTION_DIM) * 2 - 1
    found = sample_actions(previous, 5, torch.Generator().manual_seed(0))
    assert found.shape == (20, 30, 5, spec.ACTION_DIM)
    assert found.abs().max() <= 1.0
    change = (found - previous[:, :, None]).abs()
    assert change.max() <= spec.ACTION_RATE_LIMIT + 1e-6
    assert (change > spec.ACTION_RATE_LIMIT - 1e-6).float().mean() > 0.5  # most targets are far
    assert found.std(2).mean() > 0.1


def test_targets_are_the_value_of_the_recorded_and_the_sampled_actions() -> None:
    model, batch = toy_model(), random_batch(2, 5)
    batch.valid[1, 3:] = False
    value, sampled = _value(batch), _sampled(batch)
    carry = filter_sequence(model, batch).carry
    found = value_targets(model, carry, batch, value, sampled)
    assert torch.equal(found.usable, batch.valid)  # also rows whose return is incomplete
    assert found.action.shape == (2, 5, 3, spec.ACTION_DIM)
    state = model.standardise(batch.state)
    recorded = value(state, batch.privileged, batch.action)
    torch.testing.assert_close(found.value[..., 0], recorded)
    other = value(state, batch.privileged, sampled[:, :, 1])
    torch.testing.assert_close(found.value[..., 2], other)
    assert not torch.allclose(recorded, other)


def test_without_a_privileged_value_the_target_is_the_return() -> None:
    model, batch = toy_model(), random_batch(2, 5)
    batch.mc_valid[0, 3:] = False
    carry = filter_sequence(model, batch).carry
    found = value_targets(model, carry, batch, None, _sampled(batch))
    assert found.value.shape == (2, 5, 1)
    torch.testing.assert_close(
        found.value[..., 0], (batch.mc_return - model.return_mean) / model.return_std
    )
    assert torch.equal(found.usable, batch.mc_valid)


@pytest.mark.parametrize(("q_target", "count"), [("privileged", 7), ("mc", 0), ("td", 0)])
def test_actions_are_sampled_for_the_privileged_value_only(q_target: str, count: int) -> None:
    loss = dataclasses.replace(DEBUG.loss, q_target=q_target)  # type: ignore[arg-type]
    model, batch = WorldModel(dataclasses.replace(DEBUG, loss=loss)), random_batch(2, 5)
    assert sample_step_noise(model, batch).actions.shape == (2, 5, count, spec.ACTION_DIM)


def test_the_gradient_reaches_the_model_and_is_that_of_the_loss() -> None:
    batch = random_batch(3, 6)
    batch.is_first[1, 3] = True
    batch.valid[2, 4:] = False
    value, model, other = _value(batch), toy_model().train(), toy_model().train()
    draws = sample_step_noise(model, batch, torch.Generator().manual_seed(0))
    loss, terms = world_model_loss(model, batch, draws, value)
    loss.backward()  # type: ignore[no-untyped-call]
    found, parts, _ = world_model_gradients(other, batch, draws, value)
    torch.testing.assert_close(found, loss.detach())
    torch.testing.assert_close(parts, terms)
    for (name, a), b in zip(model.named_parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(b.grad, a.grad, rtol=1e-3, atol=1e-5, msg=name)
    assert all(p.grad is None for p in value.parameters())


def test_q_learns_how_the_value_depends_on_actions_that_were_not_taken() -> None:
    """All recorded actions are equal; the value is the first coordinate of the action."""
    torch.manual_seed(0)
    batch = random_batch(4, 4)
    batch.action.zero_()
    batch.prev_action.zero_()

    class First(PrivilegedValue):
        def forward(self, state: Tensor, privileged: Tensor, action: Tensor) -> Tensor:
            return action[..., 0].float().expand(*action.shape[:-1])

    value = First(batch.privileged.shape[-1])
    loss = dataclasses.replace(DEBUG.loss, depth=0.0, multistep_depth=0.0)
    model = WorldModel(dataclasses.replace(DEBUG, loss=loss, value_loss="mse")).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    generator = torch.Generator().manual_seed(0)
    for _ in range(120):
        draws = sample_step_noise(model, batch, generator)
        world_model_gradients(model, batch, draws, value)
        optimizer.step()
    with torch.no_grad():
        carry = filter_sequence(model, batch).carry
        action = batch.action.clone()
        low, high = (
            model.value(carry, torch.cat([action[..., :1] + x, action[..., 1:]], -1))
            for x in (-0.3, 0.3)
        )
    assert (high - low).mean() == pytest.approx(0.6, abs=0.15)


def test_a_value_is_restored_from_its_state() -> None:
    batch = random_batch(2, 3)
    value = _value(batch)
    value.mean.fill_(0.5)
    copy = PrivilegedValue.restore(value.state_dict())
    args = batch.state, batch.privileged, batch.action
    assert torch.equal(copy(*args), value(*args))
    assert not any(p.requires_grad for p in copy.parameters())
