"""Position and velocity of the task's object are decoded in training, in rows that know it."""

import dataclasses

import pytest
import torch

from egovcp import spec
from egovcp.errors import UsageError
from egovcp.model import PRESETS, LossConfig, WorldModel, world_model_loss
from egovcp.model.losses import filter_sequence, object_loss, pixel_weights
from egovcp.model.multistep import multistep_losses
from egovcp.testing import random_batch, toy_model


def _model(**loss: float) -> WorldModel:
    config = PRESETS["debug"]
    return toy_model(dataclasses.replace(config, loss=dataclasses.replace(config.loss, **loss)))


def test_the_loss_is_the_squared_error_of_known_valid_rows() -> None:
    model, batch = toy_model(), random_batch(3, 6)
    batch.valid[1, 4:] = False
    rollout = filter_sequence(model, batch)
    counted = batch.valid & batch.object_known
    error = model.standardised_object(rollout.carry) - model.standardise_object(batch.object)
    torch.testing.assert_close(
        object_loss(model, rollout, batch), 0.5 * error[counted].square().mean()
    )


def test_states_imagined_ahead_are_compared_with_the_object_at_their_row() -> None:
    model, batch = _model(multistep_stride=1, multistep_horizons=(3,)), random_batch(2, 6)
    rollout = filter_sequence(model, batch)
    errors = []
    for start in range(3):
        carry = type(rollout.carry)(rollout.carry.h[:, start], rollout.carry.z[:, start])
        for k in range(3):
            carry = model.imagine(carry, batch.action[:, start + k])
        truth = model.standardise_object(batch.object[:, start + 3])
        wrong = model.standardised_object(carry) - truth
        errors.append(wrong[batch.object_known[:, start + 3]])
    expected = model.config.loss.multistep_object * 0.5 * torch.cat(errors).square().mean()
    weight = pixel_weights(rollout.near, batch, model)
    found = multistep_losses(model, rollout, batch, weight, first=0)["multistep_object"]
    torch.testing.assert_close(found, expected)


def test_both_terms_are_zero_where_no_object_is_known() -> None:
    batch = random_batch(2, 6)
    batch.privileged[..., spec.OBJECT_KNOWN] = 0.0
    _, terms = world_model_loss(toy_model(), batch)
    assert terms["loss/object"] == terms["loss/multistep_object"] == 0


@pytest.mark.parametrize("name", ["object", "multistep_object"])
def test_a_weight_of_zero_leaves_out_its_term(name: str) -> None:
    _, every = world_model_loss(toy_model(), random_batch(2, 6))
    _, found = world_model_loss(_model(**{name: 0.0}), random_batch(2, 6))
    assert every.keys() - found.keys() == {f"loss/{name}"}


def test_without_weights_there_is_no_decoder() -> None:
    model = _model(object=0.0, multistep_object=0.0)
    assert model.object_head is None
    assert WorldModel(PRESETS["paper"]).object_head is None
    carry = model.initial(1)
    with pytest.raises(UsageError, match="does not decode the object's position"):
        model.object_position(carry)


def test_a_copy_without_the_decoder_is_otherwise_the_same() -> None:
    model = toy_model()
    copy = model.without_object_head()
    assert copy.config.loss == LossConfig(object=0.0, multistep_object=0.0)
    state, names = model.state_dict(), {n for n, _ in model.named_parameters() if "object" in n}
    assert names
    assert copy.state_dict().keys() == state.keys() - names
    assert all(torch.equal(value, state[name]) for name, value in copy.state_dict().items())
    assert model.object_head is not None


def test_position_and_velocity_are_learned_from_the_states() -> None:
    torch.manual_seed(0)
    model, batch = toy_model(), random_batch(8, 6)
    batch.object[:] = 0.3 * batch.state[..., :6]
    optimizer = torch.optim.Adam(model.parameters(), lr=5e-3)
    for _ in range(150):
        loss = object_loss(model, filter_sequence(model, batch), batch)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    with torch.no_grad():
        carry = filter_sequence(model, batch).carry
        truth = model.standardise_object(batch.object)
        error = (model.standardised_object(carry) - truth)[batch.object_known]
        distance = model.object_position(carry) - batch.object[..., :3]
    assert error.square().mean() < 0.1 * truth.var()
    assert distance[batch.object_known].square().mean() < 0.1 * batch.object[..., :3].var()
