"""A batch that two processes share gives the loss and the gradient of the whole."""

import pytest
import torch
from torch import Tensor

from egovcp.model import Batch, WorldModel, world_model_loss
from egovcp.model.parallel import DataParallelRank, data_parallel, over_all_rows, row_noise
from egovcp.testing import random_batch, toy_model
from tests.support.data_parallel import in_two_processes

ROWS = 2  # of each of two processes


def _uneven() -> Batch:
    """The first process' rows are mostly padding and without returns, the second's whole."""
    batch = random_batch(2 * ROWS, 8, seed=3)
    batch.valid[0, 2:] = False
    batch.valid[1, 5:] = False
    batch.mc_valid[0] = False
    batch.mc_valid[1, 3:] = False
    batch.terminal_next[2, -1] = True
    batch.is_first[3, 4] = True
    return batch


def _part(batch: Batch, rank: int) -> Batch:
    return Batch(*(x[rank * ROWS : (rank + 1) * ROWS] for x in batch))


def _learned(model: WorldModel, batch: Batch) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    generator = torch.Generator().manual_seed(7)
    loss, terms = world_model_loss(model, batch, generator)
    loss.backward()  # type: ignore[no-untyped-call]
    gradients = {k: p.grad for k, p in model.named_parameters() if p.grad is not None}
    return {**terms, "total": loss.detach()}, gradients


@pytest.mark.parametrize("preset", ["debug", "paper"])
def test_losses_and_gradients_add_up_to_those_of_the_whole_batch(preset: str) -> None:
    batch = _uneven()

    def work(share: DataParallelRank) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        with data_parallel(share):
            return _learned(models[share.rank], _part(batch, share.rank))

    models = [toy_model(preset), toy_model(preset)]
    (terms_a, grad_a), (terms_b, grad_b) = in_two_processes(work)
    terms, gradients = _learned(toy_model(preset), batch)
    for name, value in terms.items():
        torch.testing.assert_close(terms_a[name] + terms_b[name], value, rtol=1e-4, atol=1e-5)
    for name, value in gradients.items():
        torch.testing.assert_close(grad_a[name] + grad_b[name], value, rtol=1e-3, atol=1e-5)


def test_means_of_each_process_alone_would_not_add_up() -> None:
    """The masks of the test above differ enough to tell the two apart."""
    batch = _uneven()
    terms, _ = _learned(toy_model(), batch)
    alone = [_learned(toy_model(), _part(batch, rank))[0]["loss/value"] for rank in (0, 1)]
    assert not torch.isclose(sum(alone) / 2, terms["loss/value"], rtol=1e-3)


def test_the_noise_is_that_of_the_whole_batch() -> None:
    def draw(share: DataParallelRank) -> tuple[Tensor, Tensor]:
        generator = torch.Generator().manual_seed(1)
        with data_parallel(share):
            noise = row_noise((ROWS, 5), generator, torch.device("cpu"))
        return noise, torch.rand(3, generator=generator)

    (a, after_a), (b, after_b) = in_two_processes(draw)
    generator = torch.Generator().manual_seed(1)
    assert torch.equal(torch.cat([a, b]), torch.randn(2 * ROWS, 5, generator=generator))
    after = torch.rand(3, generator=generator)
    assert torch.equal(after_a, after)
    assert torch.equal(after_b, after)


def test_the_share_ends_with_its_context() -> None:
    with data_parallel(DataParallelRank(0, 2, lambda x: 2 * x)):
        assert over_all_rows(torch.tensor(3.0)) == 6.0
    assert over_all_rows(torch.tensor(3.0)) == 3.0
