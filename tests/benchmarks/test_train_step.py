"""The training benchmark: its plain step has the same loss, and it runs on a dataset."""

import json
from pathlib import Path

import pytest
import torch
import train_step
from plain_step import PlainModel, plain_loss
from writer import make_episode, write_dataset

from egovcp.model import WorldModel, WorldModelConfig, world_model_loss
from egovcp.testing import random_batch


@pytest.mark.parametrize("seed", range(3))
def test_the_plain_step_has_the_same_loss(seed: int) -> None:
    torch.manual_seed(seed)
    model, batch = WorldModel(WorldModelConfig()), random_batch(2, 20, seed=seed)
    batch.is_first[1, 7] = True
    torch.nn.init.normal_(model.value_head.rest[-1].weight)  # type: ignore[arg-type]
    with torch.no_grad():
        ours, terms = world_model_loss(model, batch, torch.Generator().manual_seed(1))
        plain = plain_loss(PlainModel(model), batch, torch.Generator().manual_seed(1))
    assert terms["loss/value"] > 0.01 * ours
    torch.testing.assert_close(plain, ours, rtol=1e-4, atol=0.0)


@pytest.mark.slow
def test_a_given_dataset_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root, out = tmp_path / "dataset", tmp_path / "metrics.json"
    write_dataset(root, [make_episode(i, 40) for i in range(3)])
    flags = f"--root {root} --json {out} --batches 2 --threads 1 --rounds 1"
    monkeypatch.setattr("sys.argv", ["train_step.py", *flags.split()])
    train_step.main()
    metrics = json.loads(out.read_text())
    assert metrics["step_2_threads_1_ratio"] > 0
    assert metrics["step_2_threads_1_loss_difference"] <= train_step.TOLERANCE
