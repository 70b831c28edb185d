"""t-SNE keeps neighbours together and separates what is apart."""

from __future__ import annotations

import torch

from egovcp_experiment.tsne import _joint, tsne


def clusters(count: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    """Three clusters in 20 dimensions, 8 deviations apart."""
    generator = torch.Generator().manual_seed(0)
    label = torch.arange(3).repeat_interleave(count)
    centres = 8 * torch.randn(3, 20, generator=generator) / 20**0.5 * 3
    return centres[label] + torch.randn(3 * count, 20, generator=generator), label


def test_clusters_stay_apart() -> None:
    points, label = clusters()
    flat = tsne(points, perplexity=15.0, iterations=300)
    distance = torch.cdist(flat, flat).fill_diagonal_(torch.inf)
    nearest = distance.topk(5, largest=False).indices
    assert (label[nearest] == label[:, None]).double().mean() > 0.99
    means = torch.stack([flat[label == k].mean(0) for k in range(3)])
    spread = max(float(flat[label == k].std(0).max()) for k in range(3))
    assert torch.pdist(means).min() > 3 * spread


def test_the_perplexity_is_the_number_of_neighbours() -> None:
    points, _ = clusters(20)
    p = _joint(points.double(), perplexity=10.0)
    assert torch.isclose(p.sum(), torch.tensor(1.0, dtype=torch.float64), atol=1e-6)
    assert torch.equal(p, p.T)
    entropy = -(p * p.log()).sum() - torch.log(torch.tensor(60.0))
    assert 8.0 < entropy.exp() < 14.0


def test_neither_order_nor_repetition_changes_the_picture() -> None:
    points, _ = clusters(15)
    flat = tsne(points, iterations=60)
    torch.testing.assert_close(tsne(points, iterations=60), flat)
    torch.testing.assert_close(
        tsne(points.flip(0), iterations=30).flip(0),
        tsne(points, iterations=30),
        atol=1e-2,
        rtol=1e-2,
    )


def test_a_handful_of_points_is_enough() -> None:
    assert tsne(torch.randn(3, 5)).shape == (3, 2)
    assert tsne(torch.randn(6, 1)).isfinite().all()
