"""The error of pictures and its gradient."""

import pytest
import torch

from egovcp.model.losses import image_error


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_it_is_half_the_weighted_mean_of_squares_and_so_is_its_gradient(dtype: torch.dtype) -> None:
    rng = torch.Generator().manual_seed(0)
    image, near, weight = torch.rand(3, 2, 5, 6, 7, generator=rng)
    image = image.to(dtype).requires_grad_()
    counts = torch.rand(2, 5, generator=rng)
    expected = (0.5 * weight * (image.float() - near).square()).mean((-2, -1))
    found = image_error(image, near, weight)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, expected)
    gradients = [
        torch.autograd.grad((counts * error).sum(), image)[0] for error in (found, expected)
    ]
    torch.testing.assert_close(*gradients)


def test_its_gradient_is_that_of_small_differences() -> None:
    image, near, weight = torch.rand(3, 4, 3, 5, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: image_error(x, near, weight), image.requires_grad_())
