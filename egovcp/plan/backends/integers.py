"""The planning network's layers in 8-bit integers, by `kernel.c`; one robot's rows on one thread.

Weights have a scale per output, inputs a scale per row: what a row gives does not depend on the
rows beside it.
"""

from __future__ import annotations

import ctypes
from typing import Final, NamedTuple

import torch
from torch import Tensor

from egovcp.errors import UsageError
from egovcp.plan.backends import library
from egovcp.plan.backends.layers import GruLayer, HiddenLayer

LANES: Final = 16
WIDEST: Final = 1024
LEAST_SILU: Final = -0.27846456
"""The least value of SiLU: bytes of hidden layers count from there."""
LEVELS: Final = 127


class Bytes(NamedTuple):
    """Rows of a wide input."""

    values: Tensor  # (rows, K) uint8
    scale: Tensor  # (rows,)


class IntegerArithmetic:
    """See `Arithmetic`; compiles the kernel if need be.

    Raises:
        EnvironmentFailure: the kernel cannot be built.
    """

    def __init__(self) -> None:
        library.library()

    def hidden(self, layer: HiddenLayer) -> IntegerHidden:
        """See `Arithmetic`."""
        return IntegerHidden(layer)

    def recurrence(self, layer: GruLayer) -> IntegerRecurrence:
        """See `Arithmetic`."""
        return IntegerRecurrence(layer)

    def linear(self, h: Tensor, z: Tensor) -> IntegerLinear:
        """See `Arithmetic`; these few products stay in float32."""
        return IntegerLinear(h, z)


class _Memory:
    """A layer's description for the kernel, and the tensors that it points into."""

    def __init__(self, outputs: int, gamma: Tensor, beta: Tensor, epsilon: float) -> None:
        if outputs % LANES or outputs > WIDEST:
            raise UsageError(
                f"a layer of {outputs} units: the int8 planner takes multiples of {LANES} up to "
                f"{WIDEST}; {library.OTHERWISE}"
            )
        self._kept: list[Tensor] = []
        self.layer = library.Layer()
        self.layer.outputs, self.layer.epsilon = outputs, epsilon
        self.layer.gamma, self.layer.beta = self.keep(gamma), self.keep(beta)
        self.address = ctypes.byref(self.layer)

    def keep(self, tensor: Tensor, dtype: torch.dtype = torch.float32) -> int:
        """The address of a copy."""
        self._kept.append(tensor.detach().to("cpu", dtype).contiguous().clone())
        return self._kept[-1].data_ptr()

    def wide(self, index: int, weight: Tensor, state: bool) -> None:
        """Set a wide weight (N, K) for inputs of h (symmetric) or of a hidden layer."""
        zero, offset = (128, 0.0) if state else (0, LEAST_SILU)
        weight = weight.detach().float().cpu()
        outputs, inputs = weight.shape
        if inputs % 4 or inputs > WIDEST:
            raise UsageError(f"a layer of {inputs} inputs; {library.OTHERWISE}")
        scale = weight.abs().amax(1).clamp_min(1e-12) / LEVELS
        whole = (weight / scale[:, None]).round()
        total = whole.sum(1)
        blocks = whole.view(outputs // LANES, LANES, inputs // 4, 4).transpose(1, 2)
        self.layer.wide[index] = library.Wide(
            inputs,
            self.keep(blocks, torch.int8),
            self.keep(scale),
            self.keep(-zero * total, torch.int32),
            self.keep(offset * scale * total),
        )

    def top(self, weight: Tensor, bias: Tensor) -> None:
        """Set the linear layer on top, filled up to whole vectors."""
        last = -(-len(bias) // LANES) * LANES
        self.layer.last = last
        self.layer.last_weight = self.keep(_filled(weight, last).t())
        self.layer.last_bias = self.keep(_filled(bias[:, None], last)[:, 0])


def _filled(rows: Tensor, count: int) -> Tensor:
    """(n, k) -> (count, k), zeros below."""
    return torch.cat([rows.detach(), rows.new_zeros(count - len(rows), rows.shape[1])])


def _address(tensor: Tensor | None) -> int | None:
    return None if tensor is None else tensor.data_ptr()


class IntegerHidden:
    """See `Hidden`; ``add`` is one row, (units,)."""

    def __init__(self, layer: HiddenLayer) -> None:
        self._units = len(layer.norm.weight)
        memory = _Memory(self._units, layer.norm.weight, layer.norm.bias, layer.norm.eps)
        if layer.wide is not None:
            memory.wide(0, layer.wide, layer.wide_is_state)
        if layer.narrow is not None:
            memory.layer.narrow = layer.narrow.shape[1]
            memory.layer.narrow_weight = memory.keep(layer.narrow.t())
        if layer.last is not None:
            memory.top(layer.last.weight, layer.last.bias)
            self._outputs = layer.last.out_features
        self._memory = memory

    def between(self, wide: Bytes | None, narrow: Tensor | None, add: Tensor | None) -> Bytes:
        """See `Hidden`."""
        rows = _rows(wide, narrow)
        out = Bytes(torch.empty(rows, self._units, dtype=torch.uint8), torch.empty(rows))
        self._run(rows, wide, narrow, add, out, None)
        return out

    def last(self, wide: Bytes | None, narrow: Tensor | None, add: Tensor | None) -> Tensor:
        """See `Hidden`."""
        rows = _rows(wide, narrow)
        out = torch.empty(rows, self._memory.layer.last)
        self._run(rows, wide, narrow, add, None, out)
        return out[:, : self._outputs]

    def _run(
        self,
        rows: int,
        wide: Bytes | None,
        narrow: Tensor | None,
        add: Tensor | None,
        out: Bytes | None,
        numbers: Tensor | None,
    ) -> None:
        narrow = None if narrow is None else narrow.contiguous()
        library.library().hidden(
            self._memory.address,
            rows,
            None if wide is None else wide.values.data_ptr(),
            None if wide is None else wide.scale.data_ptr(),
            _address(narrow),
            _address(add),
            LEAST_SILU,
            None if out is None else out.values.data_ptr(),
            None if out is None else out.scale.data_ptr(),
            _address(numbers),
        )


def _rows(wide: Bytes | None, narrow: Tensor | None) -> int:
    if wide is not None:
        return len(wide.scale)
    assert narrow is not None
    return len(narrow)


class IntegerRecurrence:
    """See `Recurrence`; ``add`` is one row, and so is an h that all rows share."""

    def __init__(self, layer: GruLayer) -> None:
        self._memory = _Memory(len(layer.beta), layer.gamma, layer.beta, layer.epsilon)
        self._memory.wide(0, layer.wide_x, state=False)
        self._memory.wide(1, layer.wide_h, state=True)

    def __call__(
        self, x: Bytes, wide_h: Bytes | None, add: Tensor | None, h: Tensor
    ) -> tuple[Tensor, Bytes]:
        """See `Recurrence`."""
        rows, size = len(x.scale), h.shape[-1]
        after = torch.empty(rows, size)
        out = Bytes(torch.empty(rows, size, dtype=torch.uint8), torch.empty(rows))
        library.library().recur(
            self._memory.address,
            rows,
            x.values.data_ptr(),
            x.scale.data_ptr(),
            None if wide_h is None else wide_h.values.data_ptr(),
            None if wide_h is None else wide_h.scale.data_ptr(),
            _address(add),
            h.data_ptr(),
            size if h.dim() > 1 else 0,
            after.data_ptr(),
            out.values.data_ptr(),
            out.scale.data_ptr(),
        )
        return after, out


class IntegerLinear:
    """See `Linear`."""

    def __init__(self, h: Tensor, z: Tensor) -> None:
        self._outputs = len(h)
        self._last = -(-self._outputs // LANES) * LANES
        self._h = _filled(h.float().cpu(), self._last).t().contiguous()
        self._z = _filled(z.float().cpu(), self._last).t().contiguous()
        self._zero = torch.zeros(self._last)

    def __call__(self, h: Tensor, z: Tensor) -> Tensor:
        """See `Linear`."""
        rows, z = len(h), z.contiguous()
        out = torch.empty(rows, self._last)
        linear = library.library().linear
        zero = self._zero.data_ptr()
        linear(rows, h.shape[1], h.data_ptr(), self._last, self._h.data_ptr(), zero, out.data_ptr())
        linear(rows, z.shape[1], z.data_ptr(), self._last, self._z.data_ptr(), None, out.data_ptr())
        return out[:, : self._outputs]
