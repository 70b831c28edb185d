"""The gradient that is found in three pieces is that of the loss, on any number of threads."""

import dataclasses
from collections.abc import Iterator
from functools import partial
from itertools import product
from threading import current_thread, main_thread
from typing import Any

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from egovcp.model import (
    PRESETS,
    Batch,
    WorldModel,
    sample_step_noise,
    world_model_gradients,
    world_model_loss,
)
from egovcp.model.config import LossConfig
from egovcp.model.objective import run_parallel
from egovcp.testing import random_batch, toy_model
from tests.support.models import CountingModel

NOWHERE = FakeTensorMode()  # one for all: constants are kept for each device
BF16 = partial(torch.autocast, "cpu", torch.bfloat16)
CONFIGS = {
    "debug": PRESETS["debug"],
    "paper": PRESETS["paper"],
    "nothing foreseen": dataclasses.replace(
        PRESETS["debug"],
        loss=LossConfig(multistep_depth=0.0, multistep_state=0.0),
    ),
    "rewards": dataclasses.replace(PRESETS["debug"], loss=LossConfig(reward=1.0)),
    "autoregressive": dataclasses.replace(PRESETS["debug"], dynamics="autoregressive"),
    "temporal differences": dataclasses.replace(PRESETS["debug"], loss=LossConfig(q_target="td")),
    "squared error of Q": dataclasses.replace(PRESETS["debug"], value_loss="mse"),
}


@pytest.fixture(params=[1, 2, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def _gradients(model: WorldModel) -> dict[str, Tensor | None]:
    return {name: p.grad for name, p in model.named_parameters()}


@pytest.mark.parametrize(
    ("name", "threads"),
    [
        *(("debug", count) for count in (1, 3)),
        *((name, 2) for name in CONFIGS),
        *(pytest.param(*x, marks=pytest.mark.slow) for x in product(CONFIGS, (1, 3))),
    ],
    indirect=["threads"],
)
def test_it_is_the_gradient_of_the_loss(name: str, threads: int) -> None:
    batch = random_batch(3, 8)
    batch.is_first[1, 3] = True
    batch.valid[2, 6:] = False
    model, other = toy_model(CONFIGS[name]).train(), toy_model(CONFIGS[name]).train()
    loss, terms = world_model_loss(model, batch, torch.Generator().manual_seed(0))
    loss.backward()  # type: ignore[no-untyped-call]
    for _ in range(2):  # what a step before has left does not count
        draws = sample_step_noise(other, batch, torch.Generator().manual_seed(0))
        found, parts, _ = world_model_gradients(other, batch, draws)
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
    draws = sample_step_noise(other, batch, torch.Generator().manual_seed(0))
    world_model_gradients(other, batch, draws)
    torch.testing.assert_close(_gradients(other), _gradients(model), rtol=1e-3, atol=1e-5)


def test_gradients_are_the_same_numbers_each_time() -> None:
    """In bfloat16, where a weight that is cast twice would have another gradient."""
    batch, threads = random_batch(3, 8), torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        found = []
        for _ in range(4):
            model = toy_model().train()
            draws = sample_step_noise(model, batch, torch.Generator().manual_seed(0))
            world_model_gradients(model, batch, draws, precision=BF16)
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

    first, second = run_parallel(seen, seen)
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
        run_parallel(partial(work, 0), partial(work, 1))
    assert ended == ([] if threads == 1 and fails == 0 else [1 - fails])
    assert torch.get_num_threads() == threads


class NoCopies(TorchDispatchMode):
    """Fails where something is copied from the processor to a GPU: so are the numbers of a list in
    brackets."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        copies = "copy" in str(func)
        given = {
            x.device.type
            for x in tree_leaves((args, kwargs))
            if isinstance(x, Tensor) and (x.ndim or copies)  # a number is an argument
        }
        made = {x.device.type for x in tree_leaves(found) if isinstance(x, Tensor)}
        assert not ("cpu" in given and "cuda" in made), func
        return found


@pytest.mark.skipif(
    torch.cuda.is_available(), reason="what is kept for a device would be no tensor"
)
@pytest.mark.parametrize(
    "name",
    [
        *("default", "temporal differences"),
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("rewards", "autoregressive", "squared error of Q")
        ),
    ],
)
def test_nothing_of_a_loss_waits_for_a_gpu(name: str) -> None:
    """Tensors without numbers, on a device that is not there: what depends on a number fails."""
    model, batch = toy_model(CONFIGS.get(name, name)).train(), random_batch(3, 12)

    def on_gpu(x: Tensor) -> Tensor:
        with NOWHERE:
            return torch.empty_strided(x.size(), x.stride(), dtype=x.dtype, device="cuda")

    drawn = sample_step_noise(model, batch)
    draws = drawn._replace(latent=on_gpu(drawn.latent))
    for part in model.modules():
        for key, parameter in part.named_parameters(recurse=False):
            setattr(part, key, torch.nn.Parameter(on_gpu(parameter), parameter.requires_grad))
        for key, buffer in part.named_buffers(recurse=False):
            setattr(part, key, on_gpu(buffer))
    with NOWHERE:
        world_model_loss(model, Batch(*map(on_gpu, batch)), draws)  # constants are made and kept
        with NoCopies():
            loss, _ = world_model_loss(model, Batch(*map(on_gpu, batch)), draws)
    assert loss.device.type == "cuda"
    assert loss.requires_grad
