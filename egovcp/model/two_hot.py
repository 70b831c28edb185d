"""A number as a categorical distribution over fixed bins (DreamerV3's two-hot symlog regression).

The bins lie evenly in symlog(x) = sign(x) ln(1 + |x|): fine near zero, wide far out. A number is
encoded by the weights of its two neighbours whose mean it is, so that the mean of a distribution
over bins stays the mean of what it was fitted to. Cross entropy has bounded gradients: a rare,
far outlier does not pull as it does on a squared error.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Final

import torch
from torch import Tensor

BINS: Final = 81
REACH: Final = 4.0
"""symlog of the outermost bins; in return deviations they are +- 53.6, and what lies beyond
counts as lying there."""

_EVEN: Final = [REACH * (2 * i / (BINS - 1) - 1) for i in range(BINS)]
_VALUES: Final = tuple(math.copysign(math.expm1(abs(x)), x) for x in _EVEN)


def bins(like: Tensor) -> Tensor:
    """The values (BINS,), ascending, of ``like``'s device and in float32."""
    return _bins_on(like.device)


@cache
def _bins_on(device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # the cached tensor may be needed in training as well
        return torch.tensor(_VALUES, dtype=torch.float32, device=device)


def encode(x: Tensor) -> Tensor:
    """(...,) -> (..., BINS) weights that add up to 1, at most two of them not zero."""
    values = bins(x)
    x = x.float().clamp(values[0], values[-1])
    above = torch.searchsorted(values, x.contiguous()).clamp(1, BINS - 1)
    low, high = values[above - 1], values[above]
    share = ((x - low) / (high - low)).unsqueeze(-1)
    weights = torch.zeros(*x.shape, BINS, device=x.device)
    weights.scatter_(-1, above.unsqueeze(-1), share)
    return weights.scatter_(-1, above.unsqueeze(-1) - 1, 1.0 - share)


def decode(logits: Tensor) -> Tensor:
    """(..., BINS) -> the mean of the distribution, (...,)."""
    return (torch.softmax(logits.float(), -1) * bins(logits)).sum(-1)


def cross_entropy(logits: Tensor, x: Tensor) -> Tensor:
    """Of the distribution (..., BINS) and the encoded number (...,); (...,) nats."""
    return -(encode(x) * torch.log_softmax(logits.float(), -1)).sum(-1)
