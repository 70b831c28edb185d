"""Outputs of the value head: a number, or a distribution over fixed bins.

The distribution is DreamerV3's two-hot symlog regression. The bins are evenly spaced in
symlog(x) = sign(x) ln(1 + |x|). A number is encoded by weights on its two neighbouring bins whose
mean it is, so the mean of a fitted distribution is the mean of the data. The gradient of the
cross-entropy is bounded, so rare large returns dominate less than under a squared error.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Final

import torch
from torch import Tensor

from egovcp.model.config import ValueLoss

BINS: Final = 81
REACH: Final = 4.0
"""symlog of the outermost bins, +-53.6 standard deviations of the return; values are clipped."""

_EVEN: Final = [REACH * (2 * i / (BINS - 1) - 1) for i in range(BINS)]
_VALUES: Final = tuple(math.copysign(math.expm1(abs(x)), x) for x in _EVEN)


def width(kind: ValueLoss) -> int:
    """Number of outputs of a value head."""
    return 1 if kind == "mse" else BINS


def bins(kind: ValueLoss) -> Tensor | None:
    """Values (BINS,) of the bins whose logits the outputs are; None: the output is the value."""
    return None if kind == "mse" else bin_values(torch.device("cpu"))


def read(outputs: Tensor, kind: ValueLoss) -> Tensor:
    """Outputs (..., width) -> value (...,), float32: the number, or the mean of the bins."""
    if kind == "mse":
        return outputs.squeeze(-1).float()
    return (torch.softmax(outputs.float(), -1) * bin_values(outputs.device)).sum(-1)


def error(outputs: Tensor, target: Tensor, kind: ValueLoss) -> Tensor:
    """Squared error or cross-entropy (nats) of outputs (..., width) to a target (...,)."""
    if kind == "mse":
        return (read(outputs, kind) - target).square()
    return -(two_hot(target) * torch.log_softmax(outputs.float(), -1)).sum(-1)


@cache
def bin_values(device: torch.device) -> Tensor:
    """Values of the bins (BINS,), ascending, float32."""
    with torch.inference_mode(False):  # the cached tensor may also be used in training
        return torch.tensor(_VALUES, dtype=torch.float32, device=device)


def two_hot(x: Tensor) -> Tensor:
    """(...,) -> weights (..., BINS) that sum to 1, at most two of them nonzero."""
    values = bin_values(x.device)
    x = x.float().clamp(values[0], values[-1])
    above = torch.searchsorted(values, x.contiguous()).clamp(1, BINS - 1)
    low, high = values[above - 1], values[above]
    share = ((x - low) / (high - low)).unsqueeze(-1)
    weights = torch.zeros(*x.shape, BINS, device=x.device)
    weights.scatter_(-1, above.unsqueeze(-1), share)
    return weights.scatter_(-1, above.unsqueeze(-1) - 1, 1.0 - share)
