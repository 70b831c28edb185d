"""The objective: what each row is trained towards, and what must not matter."""

import dataclasses

import pytest
import torch
from torch import Tensor

from egovcp.model import PRESETS, Batch, Carry, LossConfig, WorldModel, world_model_loss
from egovcp.model.latent_state import Gaussian
from egovcp.model.losses import (
    Rollout,
    filter_sequence,
    kl_losses,
    moving_pixels,
)
from egovcp.model.value_losses import value_and_termination_losses
from egovcp.testing import random_batch, toy_model
from tests.support.models import CountingModel


def _loss(model: WorldModel, batch: Batch, seed: int = 0) -> dict[str, float]:
    with torch.no_grad():
        total, terms = world_model_loss(model, batch, torch.Generator().manual_seed(seed))
    return {"total": float(total)} | {name: float(value) for name, value in terms.items()}


def _with_loss(config: LossConfig) -> WorldModel:
    model = toy_model()
    model.config = dataclasses.replace(model.config, loss=config)
    return model


#: Nothing left to chance but the noise of z: every image is reconstructed.
EVERY_IMAGE = dataclasses.replace(PRESETS["debug"].loss, decode_every=1, multistep_stride=1)


def _pad(batch: Batch, rows: int, garbage: bool) -> Batch:
    """``rows`` more rows at the end that must not count, filled in two different ways."""
    extra = random_batch(len(batch.valid), rows, seed=9)
    if not garbage:
        extra = Batch(*(torch.zeros_like(x) for x in extra))
    padding = extra._replace(
        is_first=torch.zeros_like(extra.is_first),
        valid=torch.zeros_like(extra.valid),
        mc_valid=torch.zeros_like(extra.valid),
    )
    return Batch(*(torch.cat([a, b], 1) for a, b in zip(batch, padding, strict=True)))


@pytest.mark.parametrize("preset", PRESETS)
def test_losses_and_gradients_are_finite(preset: str) -> None:
    model = toy_model(preset).train()
    total, terms = world_model_loss(model, random_batch(2, 5))
    total.backward()  # type: ignore[no-untyped-call]
    assert all(term.isfinite() for term in terms.values())
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


def test_the_terms_add_up_to_the_total(model: WorldModel, batch: Batch) -> None:
    terms = _loss(model, batch)
    assert terms.pop("total") == pytest.approx(sum(terms.values()), rel=1e-5)


def test_a_seed_repeats_the_loss_bit_for_bit(model: WorldModel, batch: Batch) -> None:
    assert _loss(model, batch, seed=1) == _loss(model, batch, seed=1)
    assert _loss(model, batch, seed=1) != _loss(model, batch, seed=2)


def test_without_gradients_images_are_encoded_in_pieces(
    model: WorldModel, batch: Batch, monkeypatch: pytest.MonkeyPatch
) -> None:
    with torch.no_grad():
        at_once = filter_sequence(model, batch)
        seen: list[int] = []
        monkeypatch.setattr("egovcp.model.losses._CHUNK", 5)
        monkeypatch.setattr(
            model,
            "embed_near",
            lambda *x: seen.append(len(x[0])) or WorldModel.embed_near(model, *x),
        )
        in_pieces = filter_sequence(model, batch)
    assert seen == [5, 5, 5, 5, 1]
    for one, other in zip(at_once.carry, in_pieces.carry, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("garbage", [False, True])
def test_padding_changes_no_loss(batch: Batch, garbage: bool) -> None:
    model = _with_loss(EVERY_IMAGE)
    padded = _loss(model, _pad(batch, 5, garbage))
    assert padded == pytest.approx(_loss(model, batch), rel=1e-4)


def test_another_episode_before_the_start_changes_no_loss(batch: Batch) -> None:
    """Nothing is trained through ``is_first``, be it in the middle of a window."""
    first, valid = batch.is_first.clone(), batch.valid.clone()
    first[:, 3] = True
    valid[:, :3] = False
    joined = batch._replace(is_first=first, valid=valid)
    other = random_batch(size=3, length=7, seed=1)
    exchanged = {
        name: torch.cat([getattr(other, name)[:, :3], getattr(joined, name)[:, 3:]], 1)
        for name in ("depth", "state", "action", "mc_return")
    }
    model = _with_loss(EVERY_IMAGE)
    assert _loss(model, joined) == pytest.approx(
        _loss(model, joined._replace(**exchanged)), rel=1e-4
    )


def test_a_batch_without_a_valid_row_costs_nothing(model: WorldModel, batch: Batch) -> None:
    nothing = _loss(model, batch._replace(valid=torch.zeros_like(batch.valid)))
    assert nothing["total"] == 0.0


def test_rows_without_a_complete_return_do_not_train_the_value(
    model: WorldModel, batch: Batch
) -> None:
    usable = torch.zeros_like(batch.mc_valid)
    usable[:, :3] = True
    masked = batch._replace(mc_valid=usable)
    wrong = masked._replace(mc_return=torch.where(usable, batch.mc_return, 1e3))
    assert _loss(model, masked) == _loss(model, wrong)
    assert _loss(model, masked) != _loss(model, batch)


def test_burn_in_rows_fill_the_memory_but_are_not_trained_on(
    model: WorldModel, batch: Batch
) -> None:
    valid = batch.valid.clone()
    valid[:, :3] = False
    burnt = batch._replace(valid=valid)
    reward = batch.mc_return.clone()
    reward[:, :3] = 1e3
    assert _loss(model, burnt) == _loss(model, burnt._replace(mc_return=reward))
    first = burnt.is_first.clone()
    first[:, 3] = True
    assert _loss(model, burnt) != _loss(model, burnt._replace(is_first=first))


class _Recorder(CountingModel):
    """Keeps the states and actions that value and termination were asked about."""

    def __init__(self) -> None:
        super().__init__()
        self.values: list[tuple[Carry, Tensor]] = []
        self.terminations: list[Carry] = []

    def value_error(self, carry: Carry, action: Tensor, target: Tensor) -> Tensor:
        self.values.append((carry, action))
        return (carry.h[..., 0] - target).square()

    def termination_logit(self, carry: Carry) -> Tensor:
        self.terminations.append(carry)
        return carry.h[..., 0]


def _counted(batch: Batch) -> Rollout:
    """A rollout whose h[:, t, COUNT] is t, and whose latent is zero."""
    model = CountingModel()
    size, length = batch.valid.shape
    h = torch.zeros(size, length, model.config.hidden)
    h[..., CountingModel.COUNT] = torch.arange(length)
    z = torch.zeros(size, length, model.config.latent)
    flat = Gaussian(z, torch.ones_like(z))
    return Rollout(Carry(h, z), flat, flat, torch.zeros(1), batch.state)


def test_termination_judges_the_state_that_the_action_has_produced() -> None:
    batch, recorder = random_batch(2, 5), _Recorder()
    value_and_termination_losses(recorder, _counted(batch), batch, LossConfig())
    (judged,) = recorder.terminations
    ticks = torch.arange(5.0).expand(2, 5)
    torch.testing.assert_close(judged.h[..., CountingModel.COUNT], ticks)
    torch.testing.assert_close(judged.h[..., CountingModel.IMAGINED], torch.ones(2, 5))
    torch.testing.assert_close(judged.z[..., :7], batch.action)


def test_value_is_asked_about_the_action_of_its_own_row() -> None:
    batch, recorder = random_batch(2, 5), _Recorder()
    config = LossConfig(imagined_steps=3)
    value_and_termination_losses(recorder, _counted(batch), batch, config)
    for k, (states, actions) in enumerate(recorder.values):
        carry, action = states.map(lambda x: x[:, :, 0]), actions[:, :, 0]
        torch.testing.assert_close(action, batch.action[:, k:])
        start = torch.arange(5.0 - k).expand(2, 5 - k)
        torch.testing.assert_close(carry.h[..., CountingModel.COUNT], start)
        torch.testing.assert_close(
            carry.h[..., CountingModel.IMAGINED], torch.full((2, 5 - k), float(k))
        )
        if k:
            torch.testing.assert_close(carry.z[..., :7], batch.action[:, k - 1 : -1])
    assert len(recorder.values) == 4


@pytest.mark.parametrize("t", [0, 2, 4])
def test_a_fall_after_row_t_pulls_only_the_state_imagined_from_row_t(t: int) -> None:
    model, batch = toy_model(), random_batch(1, 5)
    h = torch.randn(1, 5, model.config.hidden, requires_grad=True)
    z = torch.randn(1, 5, model.config.latent)
    flat = Gaussian(z, torch.ones_like(z))
    rollout = Rollout(Carry(h, z), flat, flat, torch.zeros(1), batch.state)
    fall = batch.terminal_next.clone()
    fall[0, t] = True

    def gradient(terminal: Tensor) -> Tensor:
        losses = value_and_termination_losses(
            model, rollout, batch._replace(terminal_next=terminal), LossConfig()
        )
        (found,) = torch.autograd.grad(losses["termination"], h)
        return found

    changed = (gradient(fall) != gradient(batch.terminal_next)).any(-1)[0]
    assert changed.nonzero().flatten().tolist() == [t]


def test_learning_a_fall_raises_termination_after_it_and_nowhere_else() -> None:
    model, batch = toy_model(), random_batch(2, 6)
    batch.terminal_next[0, 3] = True
    head = list(model.termination_head.parameters())
    optimizer = torch.optim.Adam(head, lr=0.03)
    with torch.no_grad():
        rollout = filter_sequence(model, batch)
    for _ in range(80):
        losses = value_and_termination_losses(model, rollout, batch, LossConfig())
        optimizer.zero_grad()
        losses["termination"].backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    with torch.no_grad():
        after = model.termination(model.imagine(rollout.carry, batch.action))
    assert torch.equal(after > 0.5, batch.terminal_next)


def test_imagined_values_never_reach_into_another_episode(batch: Batch) -> None:
    model = _with_loss(LossConfig(imagined_steps=2))
    first = batch.is_first.clone()
    first[:, 4] = True
    joined = batch._replace(is_first=first)
    values = batch.mc_valid.clone()
    values[:, :] = False
    values[:, 4:6] = True  # targets that rows 2 and 3 must not be regressed on
    rollout = _counted(batch)
    for t, expected in ((4, False), (5, True)):
        returns = batch.mc_return.clone()
        returns[:, t] += 5.0
        one, two = (
            value_and_termination_losses(
                model,
                rollout,
                joined._replace(mc_valid=values, mc_return=r),
                model.config.loss,
            )["imagined_value"]
            for r in (batch.mc_return, returns)
        )
        assert bool(one != two) is expected


def test_without_imagined_steps_only_the_posterior_is_regressed(batch: Batch) -> None:
    model = _with_loss(LossConfig(imagined_steps=0))
    assert "loss/imagined_value" not in _loss(model, batch)
    assert "loss/termination" in _loss(model, batch)


def test_a_window_of_one_row_is_trainable(model: WorldModel) -> None:
    terms = _loss(model, random_batch(3, 1))
    assert all(torch.isfinite(torch.tensor(list(terms.values()))))


def _leaves(seed: int) -> Gaussian:
    rng = torch.Generator().manual_seed(seed)
    mean = torch.randn(2, 3, 4, generator=rng).requires_grad_()
    std = (0.2 + torch.rand(2, 3, 4, generator=rng)).requires_grad_()
    return Gaussian(mean, std)


@pytest.mark.parametrize(("term", "moved"), [("kl_prior", "prior"), ("kl_posterior", "posterior")])
def test_each_kl_term_moves_one_side(term: str, moved: str) -> None:
    q, p = _leaves(0), _leaves(1)
    empty = torch.zeros(1)
    rollout = Rollout(Carry(empty, empty), q, p, empty, empty)
    losses = kl_losses(rollout, torch.ones(2, 3).bool(), LossConfig(free_nats=0.0))
    sides = {"posterior": q.mean, "prior": p.mean}
    gradients = torch.autograd.grad(losses[term], tuple(sides.values()), allow_unused=True)
    for name, gradient in zip(sides, gradients, strict=True):
        assert (gradient is not None) == (name == moved)


def test_kl_below_the_free_nats_costs_its_floor_and_moves_nothing() -> None:
    q = _leaves(0)
    p = Gaussian((q.mean.detach() + 0.01).requires_grad_(), q.std.detach())
    empty = torch.zeros(1)
    rollout = Rollout(Carry(empty, empty), q, p, empty, empty)
    losses = kl_losses(rollout, torch.ones(2, 3).bool(), LossConfig(free_nats=1.0, kl_prior=1.0))
    assert losses["kl_prior"].item() == 1.0
    (gradient,) = torch.autograd.grad(losses["kl_prior"], p.mean)
    assert not gradient.any()


def test_moving_pixels_are_those_that_changed() -> None:
    near = torch.zeros(1, 3, 4, 4)
    near[0, 1:, 1, 1] = 0.5
    near[0, 2, 2, 2] = 0.01
    moved = moving_pixels(near, 0.04)
    assert moved.nonzero().tolist() == [[0, 1, 1, 1]]


def test_each_weight_scales_its_own_term(batch: Batch) -> None:
    config = PRESETS["debug"].loss
    plain = _loss(_with_loss(config), batch)
    terms = {name.removeprefix("loss/") for name in plain} - {"total"}
    assert {"depth", "state", "kl_prior", "kl_posterior", "termination", "value"} <= terms
    for name in terms:
        weight = {name: 2 * getattr(config, name)}
        doubled = _loss(_with_loss(dataclasses.replace(config, **weight)), batch)
        for term in terms:
            factor = 2.0 if term == name else 1.0
            assert doubled[f"loss/{term}"] == pytest.approx(factor * plain[f"loss/{term}"]), name
