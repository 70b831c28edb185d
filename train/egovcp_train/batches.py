"""From the data stream's arrays to the model's tensors and normalisation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.data import EpisodeStore, ReturnConfig
from egovcp.errors import DataError
from egovcp.model import Batch, WorldModel

DEFAULT_RETURNS = ReturnConfig()


def to_tensors(arrays: Mapping[str, NDArray[Any]], device: torch.device) -> Batch:
    """A batch of `InMemorySampler` as the tensors that the losses read."""
    depth = torch.from_numpy(arrays["depth"].astype(np.int32))
    rest = {k: torch.from_numpy(arrays[k]) for k in Batch._fields if k != "depth"}
    return Batch(depth=depth, **rest)._replace(
        **{k: v.to(device, non_blocking=True) for k, v in {"depth": depth, **rest}.items()}
    )


def set_normalisation(
    model: WorldModel, store: EpisodeStore, config: ReturnConfig = DEFAULT_RETURNS
) -> None:
    """Fix the model's statistics from the training episodes: state, return, worst return.

    Args:
        config: what the store's returns are.

    Raises:
        DataError: no return is usable, because the episodes are too short.
    """
    state = store.state.astype(np.float64)
    returns = store.mc_return[store.mc_valid]
    fix_normalisation(model, state.mean(0), state.std(0), returns, int(store.length.max()), config)


def fix_normalisation(
    model: WorldModel,
    state_mean: NDArray[np.float64],
    state_std: NDArray[np.float64],
    returns: NDArray[np.float32],
    longest: int,
    config: ReturnConfig = DEFAULT_RETURNS,
) -> None:
    """Fix the model's statistics: state (74,) each, complete returns (N,), longest episode.

    Raises:
        DataError: no return is usable, because the episodes are too short.
    """
    if len(returns) == 0:
        raise DataError(
            f"no row has a complete Monte Carlo return: the episodes (at most {longest} ticks) "
            "are not longer than --returns.steps; lower it, or collect longer episodes"
        )
    scaled = config.scale != "none"
    model.set_statistics(state_mean, state_std, returns, scaled, config.gamma)
