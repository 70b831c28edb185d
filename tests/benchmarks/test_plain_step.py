"""What a training step is measured against computes the same loss, by default."""

import pytest
import torch
from plain_step import PlainModel, plain_loss

from egovcp.model import WorldModel, WorldModelConfig, world_model_loss
from egovcp.testing import random_batch


@pytest.mark.parametrize("seed", range(3))
def test_the_plain_loss_is_ours(seed: int) -> None:
    torch.manual_seed(seed)
    model, batch = WorldModel(WorldModelConfig()), random_batch(2, 20, seed=seed)
    batch.is_first[1, 7] = True
    torch.nn.init.normal_(model.value_head.rest[-1].weight)  # type: ignore[arg-type]
    with torch.no_grad():
        ours, terms = world_model_loss(model, batch, torch.Generator().manual_seed(1))
        plain = plain_loss(PlainModel(model), batch, torch.Generator().manual_seed(1))
    assert terms["loss/value"] > 0.01 * ours
    torch.testing.assert_close(plain, ours, rtol=1e-4, atol=0.0)
