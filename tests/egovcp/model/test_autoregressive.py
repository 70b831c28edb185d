"""Autoregressive training (the baseline ARWM): predictions are fed back, and there is no KL."""

import dataclasses

import pytest
import torch
from torch import Tensor

from egovcp.errors import UsageError
from egovcp.model import PRESETS, Batch, Carry, LossConfig, WorldModel, world_model_loss
from egovcp.model.losses import filter_sequence, pixel_weights
from egovcp.model.multistep import autoregressive_losses
from egovcp.testing import random_batch, toy_model
from tests.support.batches import memory_batch

DEBUG = PRESETS["debug"]
STEPS = 3


def _config(**loss: object) -> LossConfig:
    values = {"autoregressive_steps": STEPS, "multistep_stride": 1, **loss}
    return dataclasses.replace(DEBUG.loss, **values)  # type: ignore[arg-type]


def _model(**loss: object) -> WorldModel:
    config = dataclasses.replace(DEBUG, dynamics="autoregressive", loss=_config(**loss))
    return toy_model(config)


def _losses(model: WorldModel, batch: Batch) -> dict[str, Tensor]:
    rollout = filter_sequence(model, batch)
    return autoregressive_losses(
        model, rollout, batch, pixel_weights(rollout.near, batch, model), 0
    )


def test_autoregressive_training_replaces_the_kl_terms_and_no_others(batch: Batch) -> None:
    draw = torch.Generator().manual_seed
    _, joint = world_model_loss(toy_model(), batch, draw(0))
    _, fed = world_model_loss(_model(), batch, draw(0))
    assert set(joint) - set(fed) == {"loss/kl_prior", "loss/kl_posterior"}
    added = {"depth", "state", "object"}
    assert set(fed) - set(joint) == {f"loss/autoregressive_{name}" for name in added}
    for name in ("depth", "state", "value", "termination", "imagined_value"):
        torch.testing.assert_close(fed[f"loss/{name}"], joint[f"loss/{name}"])


def test_the_networks_are_those_of_the_joint_model() -> None:
    joint, fed = toy_model().state_dict(), _model().state_dict()
    assert joint.keys() == fed.keys()
    assert all(torch.equal(joint[name], fed[name]) for name in joint)


def test_it_is_the_error_of_what_the_planner_imagines() -> None:
    """Tick by tick through `WorldModel.imagine`, each prediction from the one before it."""
    model, batch = _model(), random_batch(2, 6)
    rollout = filter_sequence(model, batch)
    weight = pixel_weights(rollout.near, batch, model)
    states, pictures = [], []
    for start in range(5):
        carry = Carry(rollout.carry.h[:, start], rollout.carry.z[:, start])
        for k in range(1, STEPS + 1):
            if start + k > 5:
                break
            carry = model.imagine(carry, batch.action[:, start + k - 1])
            wrong = model.decode_state(carry.h, carry.z) - rollout.state[:, start + k]
            states.append(0.5 * wrong.square().mean(-1))
            error = model.decode_depth(carry.features) - rollout.near[:, start + k]
            pictures.append((0.5 * weight[:, start + k] * error.square()).mean((-2, -1)))
    found, config = _losses(model, batch), model.config.loss
    torch.testing.assert_close(
        found["autoregressive_state"], config.state * torch.stack(states).mean()
    )
    torch.testing.assert_close(
        found["autoregressive_depth"], config.depth * torch.stack(pictures).mean()
    )


def test_the_gradient_of_the_last_prediction_goes_back_through_all_before_it() -> None:
    """Of all rows only the first and the last count, and the last is judged three ticks on."""
    model, batch = _model(), random_batch(1, STEPS + 1)
    action = batch.action.clone().requires_grad_(True)
    batch = batch._replace(action=action)
    batch.valid[:, 1:STEPS] = False
    (found,) = torch.autograd.grad(_losses(model, batch)["autoregressive_state"], action)
    reached = found[0].abs().sum(-1) > 0
    assert reached.tolist() == [True] * STEPS + [False]


def test_nothing_is_observed_on_the_way() -> None:
    """What is recorded between the first row and the last changes nothing but its own targets."""
    model, batch = _model(), random_batch(1, STEPS + 1)
    batch.valid[:, 1:STEPS] = False
    other = batch._replace(state=batch.state.clone(), depth=batch.depth.clone())
    other.state[:, 1:STEPS] += 3.0
    other.depth[:, 1:STEPS] = 900
    one, two = (_losses(model, b)["autoregressive_state"] for b in (batch, other))
    torch.testing.assert_close(one, two)


def test_no_steps_at_all_are_refused() -> None:
    with pytest.raises(UsageError, match="autoregressive_steps=0: expected"):
        LossConfig(autoregressive_steps=0)


@pytest.mark.slow
def test_imagination_is_learned_without_any_kl() -> None:
    """Only the first image showed a block; the value of states imagined to the end knows it."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        # a hundred steps are too few for pixels that count eleven times
        model = WorldModel(_model(proximity_weight=0.0).config)
    data = memory_batch(256, 4, seed=0)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    draws = torch.Generator().manual_seed(0)
    for step in range(100):
        optimizer.param_groups[0]["lr"] = 1e-2 * (1 - 0.009 * step)
        rows = torch.randint(256, (16,), generator=draws)
        loss, _ = world_model_loss(model, Batch(*(x[rows] for x in data)), draws)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
        optimizer.step()
    fresh = memory_batch(128, 4, seed=1)
    with torch.no_grad():
        carry = filter_sequence(model, fresh).carry
        state = Carry(carry.h[:, 0], carry.z[:, 0])
        for k in range(3):
            state = model.imagine(state, fresh.action[:, k])
        error = model.value(state, fresh.action[:, 3]) - fresh.mc_return[:, 3]
    assert 1 - error.square().mean() / fresh.mc_return[:, 3].var(correction=0) > 0.8
