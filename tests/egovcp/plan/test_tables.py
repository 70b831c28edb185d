"""Lines between nodes are the functions, within what a byte tells."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from egovcp.plan.backends.integer_network import (
    LEAST_SILU,
    NODES,
    ONE,
    UNIT,
    silu_table,
    tanh_table,
)


def _on_lines(table: Tensor, reach: float, unit: int, a: Tensor) -> Tensor:
    """As the kernel, but for its rounding."""
    places = a * NODES / reach
    node = places.round().clamp(max=NODES - 1)
    value, rise = table.double() / unit
    return value[node.long()] + rise[node.long()] * 2 * (places - node)


@pytest.mark.parametrize(
    ("function", "table", "reach", "unit", "allowed"),
    [
        (lambda a: -a * torch.sigmoid(-a), silu_table(), 8.0, UNIT, 1e-3),
        (torch.tanh, tanh_table(), 4.0, ONE, 3e-4),
    ],
    ids=["silu", "tanh"],
)
def test_lines_are_near_their_function(
    function: Callable[[Tensor], Tensor], table: Tensor, reach: float, unit: int, allowed: float
) -> None:
    a = torch.linspace(0, reach, 10_001, dtype=torch.float64)
    error = (_on_lines(table, reach, unit, a) - function(a)).abs()
    assert error.max() < allowed


def test_bytes_of_hidden_layers_count_from_below_the_least_silu() -> None:
    x = torch.linspace(-3, 0, 10_001)
    assert torch.nn.functional.silu(x).min() > LEAST_SILU
    assert silu_table()[0].min() / UNIT > LEAST_SILU
