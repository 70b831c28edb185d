"""Layer norm, SiLU and matrix products with hand-written gradients, for `fused_recurrence`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

_EPSILON = 1e-5  # of all layer norms


def _norms_mixed_dtypes(device: torch.device) -> bool:
    """Whether the layer norm kernel takes bfloat16 inputs with float32 weights."""
    return device.type == "cpu"


class LayerNorm(NamedTuple):
    """Input x and output y (R, n) of a layer norm, mean and 1 / std (R, 1)."""

    x: Tensor
    y: Tensor
    mean: Tensor
    rstd: Tensor

    @classmethod
    def apply(cls, x: Tensor, scale: Tensor, shift: Tensor) -> LayerNorm:
        """Normalise x (R, n); ``scale`` and ``shift`` (n,)."""
        if not _norms_mixed_dtypes(x.device):
            x = x.to(scale.dtype)
        return cls(x, *torch.native_layer_norm(x, scale.shape, scale, shift, _EPSILON))

    def input_gradient(self, gradient: Tensor, scale: Tensor) -> Tensor:
        """Gradient of x from that of y."""
        return self._gradients(gradient, scale, (True, False, False))[0]

    def weight_gradients(self, gradient: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of scale and shift from that of y."""
        _, of_scale, of_shift = self._gradients(gradient, scale, (False, True, True))
        return of_scale, of_shift

    def _gradients(
        self, gradient: Tensor, scale: Tensor, which: tuple[bool, bool, bool]
    ) -> tuple[Tensor, ...]:
        gradients: tuple[Tensor, ...] = torch.ops.aten.native_layer_norm_backward(
            gradient, self.x, scale.shape, self.mean, self.rstd, scale, scale, which
        )
        return gradients

    def steps(self, rows: Sequence[int]) -> list[LayerNorm]:
        """Split into one per step."""
        parts = (x.split_with_sizes(list(rows)) for x in self)
        return [LayerNorm(*part) for part in zip(*parts, strict=True)]


def silu_gradient(gradient: Tensor, x: Tensor) -> Tensor:
    """Gradient of x from that of silu(x)."""
    result: Tensor = torch.ops.aten.silu_backward(gradient.to(x.dtype), x)
    return result


def matrix_gradient(d_product: Tensor, factor: Tensor, like: Tensor) -> Tensor:
    """Gradient (m, n) of a matrix from that of its products (R, m) with a factor (R, n)."""
    return (d_product.t() @ factor).to(like.dtype)
