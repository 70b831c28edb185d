"""The gradient that is found in three pieces is that of the loss, on any number of threads."""

import dataclasses
from collections.abc import Iterator
from functools import partial
from threading import current_thread, main_thread

import pytest
import torch
from torch import Tensor

from egovcp.model import PRESETS, WorldModel, world_model_gradients, world_model_loss
from egovcp.model.config import LossConfig
from egovcp.model.threads import beside, one_thread
from egovcp.testing import CountingModel, random_batch, toy_model

BF16 = partial(torch.autocast, "cpu", torch.bfloat16)
CONFIGS = {
    "debug": PRESETS["debug"],
    "paper": PRESETS["paper"],
    "nothing foreseen": dataclasses.replace(
        PRESETS["debug"],
        loss=LossConfig(foresight_depth=0.0, foresight_state=0.0, foresight_motion=0.0),
    ),
    "rewards": dataclasses.replace(PRESETS["debug"], loss=LossConfig(reward=1.0)),
    "autoregressive": dataclasses.replace(PRESETS["debug"], dynamics="autoregressive"),
}


@pytest.fixture(params=[1, 2, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def _gradients(model: WorldModel) -> dict[str, Tensor | None]:
    return {name: p.grad for name, p in model.named_parameters()}


@pytest.mark.parametrize("name", CONFIGS)
def test_it_is_the_gradient_of_the_loss(name: str, threads: int) -> None:
    batch = random_batch(3, 8)
    batch.is_first[1, 3] = True
    batch.valid[2, 6:] = False
    model, other = toy_model(CONFIGS[name]).train(), toy_model(CONFIGS[name]).train()
    loss, terms = world_model_loss(model, batch, torch.Generator().manual_seed(0))
    loss.backward()  # type: ignore[no-untyped-call]
    for _ in range(2):  # what a step before has left does not count
        generator = torch.Generator().manual_seed(0)
        found, parts = world_model_gradients(other, batch, generator)
    assert not found.requires_grad
    torch.testing.assert_close(found, loss.detach())
    torch.testing.assert_close(parts, terms)
    expected = _gradients(model)
    assert any(g is not None for g in expected.values())
    torch.testing.assert_close(_gradients(other), expected, rtol=1e-3, atol=1e-5)
    assert torch.get_num_threads() == threads


def test_a_model_with_steps_of_its_own_learns_the_same_way() -> None:
    batch = random_batch(2, 5)
    model, other = CountingModel().train(), CountingModel().train()
    other.load_state_dict(model.state_dict())
    world_model_loss(model, batch, torch.Generator().manual_seed(0))[0].backward()  # type: ignore[no-untyped-call]
    world_model_gradients(other, batch, torch.Generator().manual_seed(0))
    torch.testing.assert_close(_gradients(other), _gradients(model), rtol=1e-3, atol=1e-5)


def test_gradients_are_the_same_numbers_each_time() -> None:
    """In bfloat16, where a weight that is cast twice would have another gradient."""
    batch, threads = random_batch(3, 8), torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        found = []
        for _ in range(6):
            model = toy_model().train()
            generator = torch.Generator().manual_seed(0)
            world_model_gradients(model, batch, generator, precision=BF16)
            found.append(_gradients(model))
    finally:
        torch.set_num_threads(threads)
    for other in found[1:]:
        for name, gradient in other.items():
            expected = found[0][name]
            if gradient is None:
                assert expected is None
            else:
                assert expected is not None
                assert torch.equal(gradient, expected), name


def test_they_share_the_threads_and_give_them_back(threads: int) -> None:
    def seen() -> tuple[int, bool]:
        return torch.get_num_threads(), current_thread() is main_thread()

    first, second = beside(seen, seen)
    shares = {1: (1, 1), 2: (1, 1), 3: (2, 1)}
    assert (first[0], second[0]) == shares[threads]
    assert (first[1], second[1]) == (True, threads == 1)
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize("fails", [0, 1])
def test_an_error_of_either_is_raised_when_both_have_ended(fails: int, threads: int) -> None:
    ended = []

    def work(number: int) -> None:
        if number == fails:
            raise ValueError(f"part {number}")
        ended.append(number)

    with pytest.raises(ValueError, match=f"part {fails}"):
        beside(partial(work, 0), partial(work, 1))
    assert ended == ([] if threads == 1 and fails == 0 else [1 - fails])
    assert torch.get_num_threads() == threads


def test_what_is_too_small_to_be_shared_has_one_thread(threads: int) -> None:
    with one_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == threads
