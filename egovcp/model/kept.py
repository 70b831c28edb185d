"""Constant tensors, made once per device: where an operation costs its call and little else, making
a tensor of Python's numbers costs as much as several of them."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from torch import Tensor

type Numbers = float | tuple[Any, ...]
"""Nested tuples."""


def constant(numbers: Numbers, like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Of the type, if it is not said, and on the device of ``like``; never to be written to."""
    return _made(numbers, dtype or like.dtype, like.device)


@cache
def _made(numbers: Numbers, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # what is kept may be wanted in training, too
        return torch.tensor(numbers, dtype=dtype, device=device)
