"""The planning network's layers in floating point, on any device.

Products in ``dtype``; states, narrow inputs and sums in float32.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from egovcp.plan.backends.layers import GruLayer, HiddenLayer


class FloatHidden:
    """One hidden layer, and the linear layer on top if it is the last one."""

    def __init__(self, layer: HiddenLayer, dtype: torch.dtype) -> None:
        self._dtype = dtype
        self._wide = None if layer.wide is None else layer.wide.to(dtype).t().contiguous()
        self._narrow = None if layer.narrow is None else layer.narrow.t().contiguous()
        self._gamma, self._beta = layer.norm.weight.detach(), layer.norm.bias.detach()
        self._epsilon = layer.norm.eps
        if layer.last is not None:
            self._last, self._bias = layer.last.weight.detach(), layer.last.bias.detach()

    def _outputs(self, wide: Tensor | None, narrow: Tensor | None, add: Tensor | None) -> Tensor:
        total = add
        if wide is not None:
            assert self._wide is not None
            part = (wide @ self._wide).float()
            total = part if total is None else total + part
        if narrow is not None:
            assert self._narrow is not None
            part = narrow @ self._narrow
            total = part if total is None else total + part
        assert total is not None
        normal = F.layer_norm(total, self._gamma.shape, self._gamma, self._beta, self._epsilon)
        return F.silu(normal)

    def between(self, wide: Tensor | None, narrow: Tensor | None, add: Tensor | None) -> Tensor:
        """The layer's outputs, for a further layer; ``add`` is a sum that all rows share."""
        return self._outputs(wide, narrow, add).to(self._dtype)

    def last(self, wide: Tensor | None, narrow: Tensor | None, add: Tensor | None) -> Tensor:
        """(..., outputs) of the linear layer on top."""
        return F.linear(self._outputs(wide, narrow, add), self._last, self._bias)


class FloatRecurrence:
    """The GRU."""

    def __init__(self, layer: GruLayer, dtype: torch.dtype) -> None:
        self._dtype = dtype
        self._x = layer.wide_x.to(dtype).t().contiguous()
        self._h = layer.wide_h.to(dtype).t().contiguous()
        self._layer = layer

    def __call__(
        self, x: Tensor, wide_h: Tensor | None, add: Tensor | None, h: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The next h, in float32 and as a wide input; the part of h comes from ``wide_h`` or is
        in ``add``."""
        total = (x @ self._x).float()
        if wide_h is not None:
            total = total + (wide_h @ self._h).float()
        if add is not None:
            total = total + add
        layer = self._layer
        normal = F.layer_norm(total, layer.gamma.shape, layer.gamma, layer.beta, layer.epsilon)
        reset, candidate, update = normal.chunk(3, -1)
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        after = torch.lerp(h.expand_as(candidate), candidate, torch.sigmoid(update))
        return after, after.to(self._dtype)


class FloatLinear:
    """A linear layer of few outputs on h and z, from its weights (outputs, n) of each."""

    def __init__(self, h: Tensor, z: Tensor) -> None:
        self._h, self._z = h.t().contiguous(), z.t().contiguous()

    def __call__(self, h: Tensor, z: Tensor) -> Tensor:
        """(..., outputs)."""
        return h @ self._h + z @ self._z
