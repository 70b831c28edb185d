"""The planning network's layers in float32, on any device."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from egovcp.plan.backends.layers import GruLayer, HiddenLayer


class FloatHidden:
    """One hidden layer, and the linear layer on top if it is the last one."""

    def __init__(self, layer: HiddenLayer) -> None:
        self._wide = None if layer.wide is None else layer.wide.t().contiguous()
        self._narrow = None if layer.narrow is None else layer.narrow.t().contiguous()
        self._gamma, self._beta = layer.norm.weight.detach(), layer.norm.bias.detach()
        self._epsilon = layer.norm.eps
        if layer.last is not None:
            self._last, self._bias = layer.last.weight.detach(), layer.last.bias.detach()

    def __call__(
        self, wide: Tensor | None = None, narrow: Tensor | None = None, add: Tensor | None = None
    ) -> Tensor:
        """The layer's outputs (..., units); ``add`` is a sum that all rows share."""
        total = add
        if wide is not None:
            assert self._wide is not None
            part = wide @ self._wide
            total = part if total is None else total + part
        if narrow is not None:
            assert self._narrow is not None
            part = narrow @ self._narrow
            total = part if total is None else total + part
        assert total is not None
        normal = F.layer_norm(total, self._gamma.shape, self._gamma, self._beta, self._epsilon)
        return F.silu(normal)

    def last(self, wide: Tensor | None = None, narrow: Tensor | None = None) -> Tensor:
        """(..., outputs) of the linear layer on top."""
        return F.linear(self(wide, narrow), self._last, self._bias)


class FloatRecurrence:
    """The GRU."""

    def __init__(self, layer: GruLayer) -> None:
        self._x, self._h = layer.wide_x.t().contiguous(), layer.wide_h.t().contiguous()
        self._layer = layer

    def __call__(self, x: Tensor, h: Tensor, gates: Tensor | None = None) -> Tensor:
        """The next h (..., hidden); ``gates`` is the sum h W_h if it is already known."""
        total = x @ self._x + (h @ self._h if gates is None else gates)
        layer = self._layer
        normal = F.layer_norm(total, layer.gamma.shape, layer.gamma, layer.beta, layer.epsilon)
        reset, candidate, update = normal.chunk(3, -1)
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        return torch.lerp(h.expand_as(candidate), candidate, torch.sigmoid(update))
