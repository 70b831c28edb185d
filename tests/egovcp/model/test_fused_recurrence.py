"""The recurrence: one step serves filtering, training and imagination alike."""

import pytest
import torch
from torch import Tensor

from egovcp import spec
from egovcp.checks import check_world_model
from egovcp.model import PRESETS, Batch, Carry, WorldModel
from egovcp.model.losses import filter_sequence, latent_noise
from egovcp.testing import random_batch, toy_model
from tests.support.models import CountingModel


def _step_by_step(model: WorldModel, batch: Batch) -> Carry:
    """Filter as on the robot, one `observe` a tick; (B, T, ...)."""
    carry = model.initial(len(batch.valid))
    carries = []
    for t in range(batch.valid.shape[1]):
        carry = model.observe(
            carry,
            batch.prev_action[:, t],
            batch.depth[:, t],
            batch.state[:, t],
            batch.is_first[:, t],
        )
        carries.append(carry)
    return Carry.join(carries, lambda parts: torch.stack(parts, 1))


def _restart(batch: Batch, t: int) -> Batch:
    first = batch.is_first.clone()
    first[:, t] = True
    return batch._replace(is_first=first)


def _close(a: Carry, b: Carry) -> None:
    for x, y in zip(a, b, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_model_of_each_preset_conforms(preset: str) -> None:
    check_world_model(toy_model(preset))


def test_filtering_step_by_step_equals_the_whole_sequence(model: WorldModel, batch: Batch) -> None:
    batch = _restart(batch, 4)
    with torch.no_grad():
        whole = filter_sequence(model, batch)
        _close(whole.carry, _step_by_step(model, batch))
    torch.testing.assert_close(whole.carry.z, whole.posterior.mean)


def test_sampled_filtering_repeats_by_seed(model: WorldModel, batch: Batch) -> None:
    def run(seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        return filter_sequence(model, batch, latent_noise(model, batch, generator)).carry.z

    with torch.no_grad():
        assert torch.equal(run(1), run(1))
        assert not torch.equal(run(1), run(2))


def test_is_first_inside_a_window_forgets_everything_before(
    model: WorldModel, batch: Batch
) -> None:
    batch = _restart(batch, 3)
    other = random_batch(size=3, length=7, seed=1)
    changed = Batch(
        *(torch.cat([b[:, :3], a[:, 3:]], 1) for a, b in zip(batch, other, strict=True))
    )
    changed.prev_action[:, 3] = 1.0  # a_{t-1} belongs to the episode before
    with torch.no_grad():
        one, two = (filter_sequence(model, b).carry for b in (batch, changed))
    assert not torch.equal(one.h[:, :3], two.h[:, :3])
    _close(Carry(one.h[:, 3:], one.z[:, 3:]), Carry(two.h[:, 3:], two.z[:, 3:]))


def test_is_first_of_one_row_leaves_the_others(model: WorldModel, batch: Batch) -> None:
    first = batch.is_first.clone()
    first[1, 4] = True
    with torch.no_grad():
        plain = filter_sequence(model, batch).carry
        reset = filter_sequence(model, batch._replace(is_first=first)).carry
    changed = (plain.h != reset.h).any(-1)
    assert changed[1, 4]
    assert not changed[[0, 2]].any()
    assert not changed[1, :4].any()


def test_no_gradient_crosses_is_first(model: WorldModel) -> None:
    batch = _restart(random_batch(3, 7), 4)
    state = batch.state.clone().requires_grad_()
    action = batch.prev_action.clone().requires_grad_()
    batch = batch._replace(state=state, prev_action=action)
    carry = filter_sequence(model, batch).carry
    (gradient, of_action) = torch.autograd.grad(carry.features[:, 4:].sum(), (state, action))
    assert gradient[:, 4].abs().max() > 0
    assert gradient[:, :4].abs().max() == 0
    assert of_action[:, 5].abs().max() > 0
    assert of_action[:, :5].abs().max() == 0


def test_an_early_observation_reaches_a_late_state(model: WorldModel) -> None:
    batch = random_batch(2, 12)
    state = batch.state.clone().requires_grad_()
    carry = filter_sequence(model, batch._replace(state=state)).carry
    (gradient,) = torch.autograd.grad(carry.h[:, -1].sum(), state)
    assert gradient[:, 0].abs().max() > 0


def test_imagining_needs_no_observation_and_uses_the_action(
    model: WorldModel, batch: Batch
) -> None:
    carry = Carry(torch.randn(3, model.config.hidden), torch.randn(3, model.config.latent))
    with torch.no_grad():
        plain = model.imagine(carry, batch.action[:, 0])
        other = model.imagine(carry, batch.action[:, 1])
        seen = model.observe(
            carry, batch.action[:, 0], batch.depth[:, 0], batch.state[:, 0], torch.zeros(3).bool()
        )
    torch.testing.assert_close(plain.h, seen.h)
    torch.testing.assert_close(plain.z, model.predict(plain.h).mean)
    assert not torch.equal(plain.h, other.h)


def test_one_state_broadcasts_over_many_actions(model: WorldModel) -> None:
    carry = Carry(torch.randn(2, model.config.hidden), torch.randn(2, model.config.latent))
    actions = torch.rand(2, 5, 3, spec.ACTION_DIM) * 2 - 1
    with torch.no_grad():
        shared = model.expand_candidates(carry)
        for k in range(3):
            values = model.value(shared, actions[:, :, k])
            shared = model.imagine(shared, actions[:, :, k])
            assert values.shape == (2, 5)
        for m in range(5):
            alone = carry
            for k in range(3):
                alone = model.imagine(alone, actions[:, m, k])
            _close(Carry(shared.h[:, m], shared.z[:, m]), alone)


def test_each_row_is_filtered_as_if_it_were_alone(model: WorldModel, batch: Batch) -> None:
    with torch.no_grad():
        together = filter_sequence(model, batch).carry
        for b in range(len(batch.valid)):
            alone = filter_sequence(model, Batch(*(x[b : b + 1] for x in batch)))
            _close(together.map(lambda x, b=b: x[b : b + 1]), alone.carry)  # type: ignore[misc]


def test_the_carry_counts_ticks_and_holds_the_action_that_led_to_it() -> None:
    """The alignment of `Batch`: prev_action at t is action at t - 1, zero at the start."""
    batch = _restart(random_batch(2, 6), 3)
    carry = _step_by_step(CountingModel(), batch)
    assert carry.h[0, :, CountingModel.COUNT].tolist() == [1, 2, 3, 1, 2, 3]
    led = carry.z[..., : spec.ACTION_DIM]
    assert not led[:, [0, 3]].any()
    torch.testing.assert_close(led[:, [1, 2, 4, 5]], batch.action[:, [0, 1, 3, 4]])


def test_the_state_is_standardised_by_the_models_statistics() -> None:
    model = toy_model()
    model.state_mean.fill_(3.0)
    model.state_std.fill_(2.0)
    state = torch.tensor([3.0, 5.0, 1.0, 1e6]).repeat(1, 19)[:, : spec.STATE_DIM]
    torch.testing.assert_close(
        model.standardise(state)[0, :4], torch.tensor([0.0, 1.0, -1.0, 10.0])
    )


def test_values_are_in_units_of_return() -> None:
    model = toy_model()
    carry, action = model.initial(2), torch.zeros(2, spec.ACTION_DIM)
    with torch.no_grad():
        before = model.value(carry, action)
        model.return_mean.fill_(10.0)
        model.return_std.fill_(3.0)
        torch.testing.assert_close(model.value(carry, action), 10.0 + 3.0 * before)


def test_a_new_model_values_everything_alike() -> None:
    model = WorldModel(PRESETS["debug"])
    model.return_mean.fill_(0.7)
    carry = Carry(torch.randn(5, model.config.hidden), torch.randn(5, model.config.latent))
    with torch.no_grad():
        value = model.value(carry, torch.rand(5, spec.ACTION_DIM))
    torch.testing.assert_close(value, torch.full((5,), 0.7))


def test_a_seed_gives_the_same_weights() -> None:
    one, two, other = (toy_model(seed=s).state_dict() for s in (3, 3, 4))
    assert all(torch.equal(one[k], two[k]) for k in one)
    assert not all(torch.equal(one[k], other[k]) for k in one)


def test_a_preset_changes_the_size_or_the_losses_and_nothing_of_the_interface() -> None:
    for config in PRESETS.values():
        carry = WorldModel(config).initial(2)
        assert carry.h.shape == (2, config.hidden)
        assert carry.z.shape == (2, config.latent)
