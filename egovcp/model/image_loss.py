"""How far pictures are from what was seen, with its gradient written by hand: one pass over the
pixels on the way back, where autograd takes five."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def image_error(image: Tensor, near: Tensor, weight: Tensor) -> Tensor:
    """Mean over the pixels of half the squared error, weighted, (...,), in float32.

    Args:
        image: (..., H, W) nearness as decoded.
        near: (..., H, W) as seen; no gradient.
        weight: (..., H, W) of the pixels; no gradient.
    """
    error: Tensor = _PictureError.apply(image, near, weight)  # type: ignore[no-untyped-call]
    return error


class _PictureError(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, near: Tensor, weight: Tensor) -> Tensor:
        away = image - near
        pull = away * weight
        ctx.save_for_backward(pull)
        ctx.dtype = image.dtype
        return 0.5 * away.mul_(pull).mean((-2, -1))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (pull,) = ctx.saved_tensors
        pixels = pull.shape[-2] * pull.shape[-1]
        return (pull * (gradient / pixels)[..., None, None]).to(ctx.dtype), None, None
