"""Activations of `kernel/words.h`: straight lines between nodes, in 16-bit fixed point.

A function of a >= 0 has 64 nodes, ``spacing`` apart. Within half a spacing of a node it is the line
whose largest error is least; beyond the last one it stays as it is there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import torch
from torch import Tensor

NODES: Final = 64
UNIT: Final = 2048
"""Words of 1 in a hidden layer: up to 16, the square root of 256 units, fits into 16 bits."""
ONE: Final = 32768
"""Words of 1 in h, in tanh and in a gate."""
LEAST_SILU: Final = -571 / UNIT
"""Below the least value of SiLU, -0.27846: bytes of hidden layers count from there."""


def silu_table() -> Tensor:
    """(2, 64) of SiLU(-a), a up to 8, in UNIT: values, and half of what a piece rises."""
    return _lines(lambda a: -a * torch.sigmoid(-a), 8.0 / NODES, UNIT)


def tanh_table() -> Tensor:
    """(2, 64) of tanh(a), a up to 4, in ONE."""
    table = _lines(torch.tanh, 4.0 / NODES, ONE)
    table[0, 0] = 0  # odd
    return table


def _lines(function: Callable[[Tensor], Tensor], spacing: float, unit: int) -> Tensor:
    node = spacing * torch.arange(NODES, dtype=torch.float64)
    left, right = function(node - spacing / 2), function(node + spacing / 2)
    left[0] = 2 * function(node)[0] - right[0]  # there is nothing below 0
    value = (function(node) + (left + right) / 2) / 2
    rise = (right - left) / 2
    rise[-1] = 0.0
    return (unit * torch.stack([value, rise])).round().clamp(-ONE, ONE - 1).to(torch.int16)
