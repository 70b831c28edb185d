"""Outputs of the value head: their number, the value they stand for, and the loss."""

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
