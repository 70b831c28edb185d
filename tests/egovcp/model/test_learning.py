"""The model learns a return that only memory can tell, from an image seen ticks ago."""

import pytest
import torch

from egovcp.model import PRESETS, Batch, Carry, WorldModel, world_model_loss
from egovcp.model.losses import filter_sequence
from tests.support.batches import memory_batch

SEQUENCES, LENGTH, BATCH, STEPS, RATE = 256, 4, 16, 100, 1e-2


def _task(size: int, seed: int, forget: bool) -> Batch:
    """The memory task; ``forget`` takes the memory away at every tick."""
    batch = memory_batch(size, LENGTH, seed)
    return batch._replace(is_first=torch.ones_like(batch.is_first)) if forget else batch


def _train(forget: bool) -> WorldModel:
    """A tiny model after two seconds."""
    data = _task(SEQUENCES, seed=0, forget=forget)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = WorldModel(PRESETS["debug"])
    optimizer = torch.optim.Adam(model.parameters(), lr=RATE)
    draws = torch.Generator().manual_seed(0)
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = RATE * (1 - 0.9 * step / STEPS)
        rows = torch.randint(SEQUENCES, (BATCH,), generator=draws)
        loss, _ = world_model_loss(model, Batch(*(x[rows] for x in data)), draws)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
        optimizer.step()
    return model.eval()


def _r2(q: torch.Tensor, target: torch.Tensor) -> float:
    return float(1 - (q - target).square().mean() / target.var(correction=0))


@pytest.fixture(scope="module")
def remembering() -> WorldModel:
    return _train(forget=False)


def test_value_knows_what_only_memory_can_tell(remembering: WorldModel) -> None:
    fresh = _task(128, seed=1, forget=False)
    with torch.no_grad():
        carry = filter_sequence(remembering, fresh).carry
        values = remembering.value(carry, fresh.action)
    assert _r2(values[:, 1:], fresh.mc_return[:, 1:]) > 0.9


@pytest.mark.slow
def test_without_memory_the_same_model_cannot_know() -> None:
    """The control: were this to succeed, the test above would prove nothing."""
    model, fresh = _train(forget=True), _task(128, seed=1, forget=True)
    with torch.no_grad():
        carry = filter_sequence(model, fresh).carry
        values = model.value(carry, fresh.action)
    assert _r2(values[:, 1:], fresh.mc_return[:, 1:]) < 0.4


def test_value_holds_on_imagined_states(remembering: WorldModel) -> None:
    fresh = _task(128, seed=1, forget=False)
    with torch.no_grad():
        whole = filter_sequence(remembering, fresh).carry
        state = Carry(whole.h[:, 0], whole.z[:, 0])
        for k in range(LENGTH - 1):
            state = remembering.imagine(state, fresh.action[:, k])
        values = remembering.value(state, fresh.action[:, -1])
    assert _r2(values, fresh.mc_return[:, -1]) > 0.8


def test_the_image_survives_in_the_state(remembering: WorldModel) -> None:
    fresh = _task(32, seed=1, forget=False)
    with torch.no_grad():
        carry = filter_sequence(remembering, fresh).carry
        first = Carry(carry.h[:, 0], carry.z[:, 0])
        near = remembering.decode_depth(first.features)
    halves = torch.stack([near[..., :32].mean((1, 2)), near[..., 32:].mean((1, 2))], 1)
    left = fresh.depth[:, 0, 0, 0] > 0
    assert torch.equal(halves[:, 0] > halves[:, 1], left)
