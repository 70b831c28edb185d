"""The planning network's layers in floating point, on any device; `R` is a tensor."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from egovcp.plan.backends.layers import GruLayer, HiddenLayer


@dataclass(frozen=True)
class FloatArithmetic:
    """Products in ``dtype``; states, narrow inputs and sums in float32."""

    dtype: torch.dtype = torch.float32

    def hidden(self, layer: HiddenLayer) -> FloatHidden:
        """See `Arithmetic`."""
        return FloatHidden(layer, self.dtype)

    def recurrence(self, layer: GruLayer) -> FloatRecurrence:
        """See `Arithmetic`."""
        return FloatRecurrence(layer, self.dtype)

    def linear(self, h: Tensor, z: Tensor) -> FloatLinear:
        """See `Arithmetic`."""
        return FloatLinear(h, z)


class FloatHidden:
    """See `Hidden`."""

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
        """See `Hidden`."""
        return self._outputs(wide, narrow, add).to(self._dtype)

    def last(self, wide: Tensor | None, narrow: Tensor | None, add: Tensor | None) -> Tensor:
        """See `Hidden`."""
        return F.linear(self._outputs(wide, narrow, add), self._last, self._bias)


class FloatRecurrence:
    """See `Recurrence`."""

    def __init__(self, layer: GruLayer, dtype: torch.dtype) -> None:
        self._dtype = dtype
        self._x = layer.wide_x.to(dtype).t().contiguous()
        self._h = layer.wide_h.to(dtype).t().contiguous()
        self._layer = layer

    def __call__(
        self, x: Tensor, wide_h: Tensor | None, add: Tensor | None, h: Tensor
    ) -> tuple[Tensor, Tensor]:
        """See `Recurrence`."""
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
    """See `Linear`."""

    def __init__(self, h: Tensor, z: Tensor) -> None:
        self._h, self._z = h.t().contiguous(), z.t().contiguous()

    def __call__(self, h: Tensor, z: Tensor) -> Tensor:
        """See `Linear`."""
        return h @ self._h + z @ self._z
