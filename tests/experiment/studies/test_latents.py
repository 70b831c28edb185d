"""Statistics of neighbours, and t-SNE maps of all states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from egovcp_experiment.cell import read_json
from egovcp_experiment.studies.latents import main, neighbours, tsne_map


def states() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Task, episode and tick of 2 tasks x 4 episodes x 20 ticks."""
    task, episode, tick = (
        part.flatten() for part in torch.meshgrid(*map(torch.arange, (2, 4, 20)), indexing="ij")
    )
    return task, episode, tick


def test_neighbours_predict_task_and_time() -> None:
    task, episode, tick = states()
    found = neighbours(torch.stack([100.0 * task, 1.0 * tick], 1), task, episode, tick)
    assert found["same_task"] == 1.0
    assert found["chance"] == pytest.approx(0.5)
    assert found["tick_r2"] > 0.95


def test_neighbours_in_noise_predict_neither() -> None:
    task, episode, tick = states()
    points = torch.randn(len(task), 4, generator=torch.Generator().manual_seed(0))
    found = neighbours(points, task, episode, tick)
    assert found["same_task"] == pytest.approx(0.5, abs=0.1)
    assert found["tick_r2"] < 0.2


def test_neighbours_are_from_other_episodes() -> None:
    """States that encode only their episode."""
    task, episode, tick = states()
    points = (10.0 * episode + 100.0 * (task * 4 + episode) ** 2)[:, None] + 0.001 * tick[:, None]
    found = neighbours(points, task, episode, tick)
    assert found["tick_r2"] < 0.5


def test_no_task_is_refused(flags: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*flags, "--tasks=[]"]) == 2
    assert "--tasks=[]: expected at least one task" in capsys.readouterr().err


@pytest.mark.slow
def test_every_task_is_in_the_maps(flags: list[str], tmp_path: Path) -> None:
    assert main([*flags, "--tasks=[ball,wall]", "--points=40"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert set(found["task"]) == {0, 1}
    assert len(found["h"]["map"]) == len(found["z"]["map"]) == len(found["tick"]) == 40


def clusters(count: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """Three clusters in 20 dimensions, 8 deviations apart."""
    generator = torch.Generator().manual_seed(0)
    label = torch.arange(3).repeat_interleave(count)
    centres = 8 * torch.randn(3, 20, generator=generator) / 20**0.5 * 3
    return centres[label] + torch.randn(3 * count, 20, generator=generator), label


def test_t_sne_keeps_clusters_apart() -> None:
    points, label = clusters()
    flat = torch.as_tensor(tsne_map(points, perplexity=15.0))
    distance = torch.cdist(flat, flat).fill_diagonal_(torch.inf)
    nearest = distance.topk(5, largest=False).indices
    assert (label[nearest] == label[:, None]).double().mean() > 0.99
    means = torch.stack([flat[label == k].mean(0) for k in range(3)])
    spread = max(float(flat[label == k].std(0).max()) for k in range(3))
    assert torch.pdist(means).min() > 3 * spread


def test_t_sne_is_deterministic_and_takes_few_points() -> None:
    points, _ = clusters(5)
    flat = tsne_map(points, perplexity=30.0)
    np.testing.assert_array_equal(tsne_map(points, perplexity=30.0), flat)
    assert tsne_map(torch.randn(4, 5), perplexity=30.0).shape == (4, 2)
