"""How a value head's outputs say a number, and what it costs to be wrong: one place for training,
the final fit and planning.

Outputs of several parts of a head add up before they are read: numbers under `mse`, log-odds of
the bins under `two_hot`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from egovcp.model import two_hot
from egovcp.model.config import ValueLoss


def width(kind: ValueLoss) -> int:
    """Outputs of a head."""
    return 1 if kind == "mse" else two_hot.BINS


def bins(kind: ValueLoss) -> Tensor | None:
    """The numbers (width,) whose log-odds the outputs are; None: an output is the value itself."""
    return None if kind == "mse" else two_hot.bins(torch.empty(0))


def read(outputs: Tensor, kind: ValueLoss) -> Tensor:
    """Outputs (..., width) -> the value (...,), float32."""
    return outputs.squeeze(-1).float() if kind == "mse" else two_hot.decode(outputs)


def error(outputs: Tensor, target: Tensor, kind: ValueLoss) -> Tensor:
    """Loss (...,) of outputs (..., width) beside the target (...,)."""
    if kind == "mse":
        return (read(outputs, kind) - target).square()
    return two_hot.cross_entropy(outputs, target)


def error_beyond(outputs: Tensor, known: Tensor, target: Tensor, kind: ValueLoss) -> Tensor:
    """`error` of a part whose outputs add to the ``known`` (..., width) of a part that is done."""
    if kind == "mse":
        return error(outputs, target - read(known, kind), kind)
    return error(known + outputs, target, kind)
