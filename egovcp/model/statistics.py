"""The statistics that a world model carries with its weights."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp import spec
from egovcp.model.world_model import WorldModel

STD_FLOOR = 0.02  # a constant value (v of the standing tasks) must not be blown up
WORST_RETURN_QUANTILE = 0.001


def set_statistics(
    model: WorldModel,
    state_mean: NDArray[np.floating],
    state_std: NDArray[np.floating],
    returns: NDArray[np.floating],
    scaled: bool = True,
    gamma: float = spec.GAMMA,
) -> None:
    """Fix the model's normalisation.

    Args:
        state_mean: (74,) of the proprioceptive state.
        state_std: (74,) its deviation.
        returns: (n,) the complete Monte Carlo returns, at least one.
        scaled: Q is fitted in deviations of these returns from their mean; else in units of return.
        gamma: their discount per tick.
    """
    values = {
        "state_mean": state_mean,
        "state_std": np.maximum(state_std, STD_FLOOR),
        "return_mean": returns.mean(dtype=np.float64) if scaled else 0.0,
        "return_std": max(float(returns.std(dtype=np.float64)), 1e-6) if scaled else 1.0,
        "min_return": np.quantile(returns, WORST_RETURN_QUANTILE),
        "discount": gamma,
    }
    for name, value in values.items():
        getattr(model, name).copy_(torch.as_tensor(value, dtype=torch.float32))
