"""What single values of the configuration change, and what they leave alone."""

import dataclasses

import pytest
import torch

from egovcp.checks import check_world_model
from egovcp.errors import UsageError
from egovcp.model import (
    PRESETS,
    Batch,
    Carry,
    LossConfig,
    WorldModel,
    WorldModelConfig,
    world_model_loss,
)
from egovcp.model.latent_state import Gaussian
from egovcp.model.losses import (
    Rollout,
    filter_sequence,
    kl_losses,
    pixel_weights,
)
from egovcp.model.value_losses import value_and_termination_losses
from egovcp.testing import random_batch, toy_model

DEBUG = PRESETS["debug"]


def _config(**changes: object) -> WorldModelConfig:
    """The debug preset with changes; ``loss__X`` stands for a loss's."""
    loss = {k.removeprefix("loss__"): v for k, v in changes.items() if k.startswith("loss__")}
    rest = {k: v for k, v in changes.items() if not k.startswith("loss__")}
    return dataclasses.replace(DEBUG, loss=dataclasses.replace(DEBUG.loss, **loss), **rest)  # type: ignore[arg-type]


OPTIONS: dict[str, dict[str, object]] = {
    "no near": {"loss__proximity_weight": 0.0},
    "dimension": {"loss__free_nats_per": "dimension"},
    "mse": {"value_loss": "mse"},
    "reward": {"loss__reward": 2.0},
    "autoregressive": {"dynamics": "autoregressive", "loss__autoregressive_steps": 3},
    "td": {"loss__q_target": "td"},
    "td and reward": {"loss__q_target": "td", "loss__reward": 1.0},
}


@pytest.mark.parametrize("name", OPTIONS)
def test_every_option_trains_and_keeps_the_contract(name: str) -> None:
    model = toy_model(_config(**OPTIONS[name]))
    check_world_model(model)
    total, _ = world_model_loss(model.train(), random_batch(2, 5))
    total.backward()  # type: ignore[no-untyped-call]
    for parameter, tensor in model.named_parameters():
        assert tensor.grad is not None, parameter
        assert tensor.grad.isfinite().all(), parameter


def test_model_has_a_reward_head_and_a_reward_loss_only_on_request(batch: Batch) -> None:
    names = {name.split(".")[0] for name in toy_model().state_dict()}
    assert "reward_head" not in names
    _, terms = world_model_loss(toy_model(), batch, torch.Generator().manual_seed(0))
    assert "loss/reward" not in terms


@pytest.mark.parametrize("name", ["mse", "reward"])
def test_options_of_the_heads_do_not_change_the_other_initial_weights(name: str) -> None:
    one, two = toy_model(), toy_model(_config(**OPTIONS[name]))
    for part in ("encode_depth", "gru", "prior", "decode_depth"):
        first, second = (getattr(m, part).state_dict() for m in (one, two))
        assert all(torch.equal(first[k], second[k]) for k in first), part


# --- value ------------------------------------------------------------------------------
def _asked(model: WorldModel) -> tuple[Carry, torch.Tensor]:
    batch = random_batch(3, 4)
    with torch.no_grad():
        return filter_sequence(model, batch).carry, batch.action


@pytest.mark.parametrize("kind", ["mse", "two_hot"])
def test_a_new_q_is_the_mean_return(kind: str) -> None:
    model = WorldModel(_config(value_loss=kind)).eval()
    model.return_mean.fill_(-2.0)
    carry, action = _asked(model)
    with torch.no_grad():
        value = model.value(carry, action)
    torch.testing.assert_close(value, torch.full_like(value, -2.0), atol=1e-4, rtol=0)


# --- reward -----------------------------------------------------------------------------
def test_a_model_without_a_reward_head_says_how_to_get_one() -> None:
    model = toy_model()
    with pytest.raises(UsageError, match=r"--policy\.loss\.reward"):
        model.reward(*_asked(model))


def _reward_loss(model: WorldModel, batch: Batch) -> torch.Tensor:
    with torch.no_grad():
        rollout = filter_sequence(model, batch)
    losses = value_and_termination_losses(model, rollout, batch, model.config.loss)
    return losses["reward"]


@pytest.mark.slow
def test_the_reward_is_learned_on_filtered_and_imagined_states() -> None:
    """Reward = the action's first coordinate, in units of reward."""
    torch.manual_seed(0)
    model = WorldModel(_config(loss__reward=1.0))
    model.return_std.fill_(4.0)
    batch = random_batch(16, 6)
    batch = batch._replace(reward=batch.action[..., 0])
    assert model.reward_head is not None
    optimizer = torch.optim.Adam(model.reward_head.parameters(), lr=0.01)
    for _ in range(150):
        optimizer.zero_grad()
        _reward_loss(model, batch).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    with torch.no_grad():
        carry = filter_sequence(model, batch).carry
        ahead = model.imagine(carry, batch.action)
        for state in (carry, ahead):
            error = model.reward(state, batch.action) - batch.reward
            assert error.square().mean() < 0.1 * batch.reward.var()


# --- losses -----------------------------------------------------------------------------
def test_near_pixels_count_more_and_only_they() -> None:
    batch = random_batch(1, 1)
    near = torch.tensor([[[[0.9, 0.72, 0.68, 0.2]]]])
    loss = LossConfig(proximity_weight=9.0, proximity_threshold=0.7, motion_weight=0.0)
    model = WorldModel(dataclasses.replace(PRESETS["debug"], loss=loss))
    assert pixel_weights(near, batch, model).flatten().tolist() == [10.0, 10.0, 1.0, 1.0]


@pytest.mark.parametrize(("per", "expected"), [("step", 4.0), ("dimension", 4.75)])
def test_free_nats_are_for_the_step_or_for_each_dimension(per: str, expected: float) -> None:
    """All KL, 4 nats, in one of four dimensions: its share is one quarter of a nat."""
    mean = torch.tensor([[[8.0**0.5, 0.0, 0.0, 0.0]]])
    one, zero = torch.ones(1, 1, 4), torch.zeros(1)
    rollout = Rollout(Carry(zero, zero), Gaussian(mean, one), Gaussian(0 * mean, one), zero, zero)
    config = LossConfig(free_nats=1.0, free_nats_per=per, kl_prior=1.0)  # type: ignore[arg-type]
    losses = kl_losses(rollout, torch.ones(1, 1).bool(), config)
    assert losses["kl_prior"].item() == pytest.approx(expected)


# --- imagination ------------------------------------------------------------------------
def test_a_drawn_state_has_one_noise_for_all_candidates() -> None:
    model = toy_model()
    carry = model.expand_candidates(
        Carry(torch.zeros(2, DEBUG.hidden), torch.zeros(2, DEBUG.latent))
    )
    action = torch.zeros(2, 5, 7)

    def drawn(seed: int) -> torch.Tensor:
        with torch.no_grad():
            return model.imagine_sample(carry, action, torch.Generator().manual_seed(seed)).z

    with torch.no_grad():
        prior = model.predict(model.transition(carry, action))
    noise = (drawn(0) - prior.mean) / prior.std
    torch.testing.assert_close(noise, noise[:1, :1].expand_as(noise))
    assert torch.equal(drawn(0), drawn(0))
    assert not torch.equal(drawn(0), drawn(1))
