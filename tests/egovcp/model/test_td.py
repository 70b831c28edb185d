"""Q by temporal differences: which rows have a target, what it is, and where it leads."""

import dataclasses

import pytest
import torch
from torch import Tensor, nn

from egovcp.model import PRESETS, Batch, Carry, LossConfig, WorldModel, WorldModelConfig
from egovcp.model.latent_state import Gaussian
from egovcp.model.losses import Rollout
from egovcp.model.value_losses import (
    TargetNetwork,
    value_and_termination_losses,
    value_targets,
)
from egovcp.testing import random_batch, toy_model

DEBUG = PRESETS["debug"]
CHAINS, STEPS, RATE = 32, 500, 1e-2
TD = LossConfig(q_target="td", value=1.0, imagined_steps=0)
CHAIN = WorldModelConfig(
    hidden=12,
    latent=2,
    units=32,
    channels=(4, 8, 8),
    value_loss="mse",
    loss=TD,
)


def _model(**change: object) -> WorldModel:
    loss = dataclasses.replace(DEBUG.loss, q_target="td")
    model = toy_model(dataclasses.replace(DEBUG, loss=loss, **change))  # type: ignore[arg-type]
    model.return_mean.fill_(-2.0)
    model.return_std.fill_(3.0)
    model.discount.fill_(0.9)
    return model


def _states(model: WorldModel, batch: Batch, seed: int = 0) -> Carry:
    rng = torch.Generator().manual_seed(seed)
    shape = batch.valid.shape
    h = torch.randn(*shape, model.config.hidden, generator=rng)
    return Carry(h, torch.randn(*shape, model.config.latent, generator=rng))


def _rollout(carry: Carry) -> Rollout:
    flat = Gaussian(carry.z, torch.ones_like(carry.z))
    none = torch.zeros(1)
    return Rollout(carry, flat, flat, none, none)


# --- targets --------------------------------------------------------------------------------
def _targets(
    model: WorldModel, carry: Carry, batch: Batch, head: nn.Module | None = None
) -> tuple[Tensor, Tensor]:
    """Targets (B, T) in units of return, and the rows that have one."""
    _, value, usable = value_targets(model, carry, batch, head)
    return value[..., 0] * model.return_std + model.return_mean, usable


def test_a_target_is_the_reward_and_the_value_of_the_action_that_followed() -> None:
    model, batch = _model(), random_batch(2, 5)
    carry = _states(model, batch)
    target, known = _targets(model, carry, batch)
    assert known.tolist() == [[True] * 4 + [False]] * 2  # what follows the window is not known
    for b in range(2):
        for t in range(4):
            after = Carry(carry.h[b, t + 1], carry.z[b, t + 1])
            with torch.no_grad():
                expected = batch.reward[b, t] + 0.9 * model.value(after, batch.action[b, t + 1])
            torch.testing.assert_close(target[b, t], expected)


def test_a_failure_has_no_afterwards_and_a_time_limit_no_target() -> None:
    """Window 0 ends an episode by a fall at row 2, window 1 by its time limit; then padding."""
    model, batch = _model(), random_batch(2, 5)
    batch.valid[:, 3:] = False
    batch.terminal_next[0, 2] = True
    target, known = _targets(model, _states(model, batch), batch)
    assert known.tolist() == [
        [True, True, True, False, False],
        [True, True, False, False, False],
    ]
    torch.testing.assert_close(target[0, 2], batch.reward[0, 2])


def test_no_target_reaches_into_another_episode_or_comes_from_burn_in() -> None:
    model, batch = _model(), random_batch(1, 6)
    batch.valid[:, 0] = False
    batch.is_first[:, 3] = True
    _, known = _targets(model, _states(model, batch), batch)
    assert known.tolist() == [[False, True, False, True, True, False]]


def test_what_q_is_fitted_to_is_one_choice() -> None:
    model, batch = _model(), random_batch(2, 5)
    carry = _states(model, batch)
    action, _, known = value_targets(model, carry, batch)
    assert torch.equal(action[:, :, 0], batch.action)
    assert not known[:, -1].any()
    model.config = DEBUG
    _, by_mc, known = value_targets(model, carry, batch)
    torch.testing.assert_close(by_mc[..., 0], (batch.mc_return + 2.0) / 3.0)
    assert torch.equal(known, batch.mc_valid)


def test_incomplete_returns_do_not_matter() -> None:
    model, batch = _model(), random_batch(2, 5)
    carry = _states(model, batch)
    none = batch._replace(mc_valid=torch.zeros_like(batch.mc_valid))
    found, expected = (value_targets(model, carry, x).usable for x in (none, batch))
    assert torch.equal(found, expected)


def test_no_gradient_goes_through_the_target() -> None:
    """Only row 0 has a target, and it is made of row 1."""
    model, batch = _model(), random_batch(1, 3)
    batch.valid[:, 2] = False
    carry = _states(model, batch)
    carry.h.requires_grad_(True)
    config = dataclasses.replace(model.config.loss, imagined_steps=0)
    losses = value_and_termination_losses(model, _rollout(carry), batch, config)
    (found,) = torch.autograd.grad(losses["value"], carry.h)
    assert found[0, 0].any()
    assert not found[0, 1:].any()


# --- the target network ---------------------------------------------------------------------
@pytest.mark.parametrize("kind", ["mse", "two_hot"])
def test_target_network_keeps_the_values_while_the_model_changes(kind: str) -> None:
    model, batch = _model(value_loss=kind), random_batch(2, 4)
    carry, network = _states(model, batch), TargetNetwork(model)
    with torch.no_grad():
        before = model.value(carry, batch.action)
        for parameter in model.value_head.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        assert not torch.allclose(model.value(carry, batch.action), before)
        torch.testing.assert_close(model.value(carry, batch.action, network.head), before)
        target, _ = _targets(model, carry, batch, network.head)
        torch.testing.assert_close(target[:, :-1], (batch.reward[:, :-1] + 0.9 * before[:, 1:]))
    assert not any(p.requires_grad for p in network.parameters())


@pytest.mark.parametrize(("decay", "expected"), [(0.75, 1.0), (0.0, 4.0)])
def test_target_network_keeps_the_decay_of_each_weight(decay: float, expected: float) -> None:
    model = _model()
    live = list(model.value_head.parameters())
    with torch.no_grad():
        torch._foreach_zero_(live)
        network = TargetNetwork(model)
        torch._foreach_add_(live, 4.0)
    network.update(model, decay)
    for parameter in network.parameters():
        torch.testing.assert_close(parameter, torch.full_like(parameter, expected))
    assert len(list(network.parameters())) == len(live)


# --- where it leads ---------------------------------------------------------------------------
def _walks(model: WorldModel, starts: Tensor, length: int, states: int, loop: bool) -> Rollout:
    """Windows of a walk that goes one state further at every tick; h says which state it is."""
    ticks = starts[:, None] + torch.arange(length)
    ticks = ticks % states if loop else ticks.clamp_max(states - 1)
    h = torch.nn.functional.one_hot(ticks, model.config.hidden).float()
    return _rollout(Carry(h, torch.zeros(*ticks.shape, model.config.latent)))


def _learn(states: int, loop: bool, gamma: float) -> Tensor:
    """Q (states,) of a chain with reward 1 at its last state, which is a failure unless it leads
    back to the first; windows of three ticks never see more than three rewards."""
    torch.manual_seed(0)
    model = WorldModel(CHAIN)
    model.discount.fill_(gamma)
    network, recorded = TargetNetwork(model), random_batch(CHAINS, 3)
    optimizer = torch.optim.Adam(model.value_head.parameters(), lr=RATE)
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = RATE * (1 - 0.95 * step / STEPS)
        rollout = _walks(model, torch.randint(states, (CHAINS,)), 3, states, loop)
        last = rollout.carry.h.argmax(-1) == states - 1
        over = (last.long().cumsum(1) > last) & (not loop)
        batch = recorded._replace(
            reward=last.float(), valid=~over, terminal_next=last & ~over & (not loop)
        )
        losses = value_and_termination_losses(model, rollout, batch, TD, network.head)
        optimizer.zero_grad()
        losses["value"].backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        network.update(model, 0.8)
    carry = _walks(model, torch.arange(states), 1, states, loop).carry
    with torch.no_grad():
        return model.value(carry, torch.zeros(states, 1, 7)).flatten()


@pytest.mark.slow
def test_rewards_beyond_every_window_are_found() -> None:
    """V(s) = gamma^(steps to the end) of a chain that ends in a failure."""
    found = _learn(states=10, loop=False, gamma=0.8)
    torch.testing.assert_close(found, 0.8 ** torch.arange(9.0, -1, -1), atol=0.06, rtol=0)


def test_the_end_of_a_window_is_not_the_end_of_the_world() -> None:
    """V(s) of a ring: the same reward again and again, V = gamma^n / (1 - gamma^5)."""
    found = _learn(states=5, loop=True, gamma=0.8)
    expected = 0.8 ** torch.arange(4.0, -1, -1) / (1 - 0.8**5)
    torch.testing.assert_close(found, expected, atol=0.1, rtol=0)
