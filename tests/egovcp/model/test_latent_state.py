import torch

from egovcp.model.latent_state import Gaussian, kl_divergence


def _random(seed: int) -> Gaussian:
    rng = torch.Generator().manual_seed(seed)
    return Gaussian.from_logits(3 * torch.randn(200, 16, generator=rng), min_std=0.1)


def test_kl_is_positive_and_vanishes_only_between_equals() -> None:
    q, p = _random(0), _random(1)
    assert (kl_divergence(q, p) > 0).all()
    torch.testing.assert_close(kl_divergence(q, q), torch.zeros(200, 8), atol=1e-6, rtol=0)


def test_kl_agrees_with_torch() -> None:
    q, p = _random(0), _random(1)
    normal = torch.distributions.Normal
    expected = torch.distributions.kl_divergence(normal(*q), normal(*p))
    torch.testing.assert_close(kl_divergence(q, p), expected)


def test_the_deviation_has_its_floor_and_starts_near_one() -> None:
    narrow = Gaussian.from_logits(torch.full((4, 16), -100.0), min_std=0.1)
    torch.testing.assert_close(narrow.std, torch.full((4, 8), 0.1))
    start = Gaussian.from_logits(torch.zeros(4, 16), min_std=0.1)
    assert ((start.std - 1).abs() < 0.15).all()
