"""What is foreseen is compared with the row that it stands for, and with no other."""

import dataclasses

import torch

from egovcp.model import Batch, WorldModel
from egovcp.model.losses import filter_sequence, pixel_weights
from egovcp.model.multistep import multistep_losses
from egovcp.testing import random_batch, toy_model


def _model(**loss: object) -> WorldModel:
    model = toy_model()
    changed = dataclasses.replace(model.config.loss, multistep_stride=1, **loss)
    model.config = dataclasses.replace(model.config, loss=changed)
    return model


def _losses(model: WorldModel, batch: Batch) -> dict[str, torch.Tensor]:
    rollout = filter_sequence(model, batch)
    weight = pixel_weights(rollout.near, batch, model)
    return multistep_losses(model, rollout, batch, weight, first=0)


def test_it_is_the_error_of_the_state_imagined_so_far_ahead() -> None:
    model, batch = _model(multistep_horizons=(3,)), random_batch(2, 6)
    rollout = filter_sequence(model, batch)
    errors = []
    for start in range(3):
        carry = type(rollout.carry)(rollout.carry.h[:, start], rollout.carry.z[:, start])
        for k in range(3):
            carry = model.imagine(carry, batch.action[:, start + k])
        wrong = model.decode_state(carry.h, carry.z) - rollout.state[:, start + 3]
        errors.append(0.5 * wrong.square().mean(-1))
    expected = model.config.loss.multistep_state * torch.stack(errors).mean()
    torch.testing.assert_close(_losses(model, batch)["multistep_state"], expected)


def test_no_window_shorter_than_the_foresight_is_judged() -> None:
    assert _losses(_model(multistep_horizons=(8,)), random_batch(2, 6)) == {}


def test_nothing_is_foreseen_across_the_start_of_an_episode() -> None:
    model, batch = _model(multistep_horizons=(2,)), random_batch(2, 6)
    batch.is_first[:, 4] = True
    other = batch._replace(state=batch.state.clone())
    other.state[:, 4:] += 5.0  # rows 4 and 5 could only be reached from the other episode
    torch.testing.assert_close(
        _losses(model, batch)["multistep_state"], _losses(model, other)["multistep_state"]
    )
