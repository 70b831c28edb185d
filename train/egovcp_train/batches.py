"""From the data stream's arrays to the model's tensors and normalisation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from egovcp.data import EpisodeStore, ReturnConfig
from egovcp.data.windows import gather, mirror_rows
from egovcp.errors import DataError
from egovcp.model import Batch, WorldModel
from egovcp.model.statistics import set_statistics
from egovcp_train.value_fit import Mirrored

EPISODES_AT_ONCE = 32
DEFAULT_RETURNS = ReturnConfig()


def to_tensors(arrays: Mapping[str, NDArray[Any]], device: torch.device) -> Batch:
    """A batch of `SequenceStream` as the tensors that the losses read."""
    depth = torch.from_numpy(arrays["depth"].astype(np.int32))
    rest = {k: torch.from_numpy(arrays[k]) for k in Batch._fields if k != "depth"}
    return Batch(depth=depth, **rest)._replace(
        **{k: v.to(device, non_blocking=True) for k, v in {"depth": depth, **rest}.items()}
    )


def whole_episodes(
    store: EpisodeStore, device: torch.device, mirror: Mirrored = "none", limit: int | None = None
) -> Iterator[Batch]:
    """Whole episodes from their start, as a robot lives through them, padded to the longest of a
    batch: episodes of one task are often several times as long as those of another.

    Args:
        mirror: and then the mirror images of these.
        limit: at most this many episodes, the first ones; None: all.
    """
    # A GPU is as fast with many as with few.
    at_once = EPISODES_AT_ONCE * (1 if device.type == "cpu" else 8)
    count = len(store.length) if limit is None else min(limit, len(store.length))
    everyone, images = np.arange(count), mirrored_episodes(store, mirror, count)
    for group in (everyone, images):
        for first in range(0, len(group), at_once):
            which = group[first : first + at_once]
            arrays = gather(store, store.start[which], which, int(store.length[which].max()))
            if group is images:
                mirror_rows(arrays, np.arange(len(which)))
            yield to_tensors(arrays, device)


def mirrored_episodes(store: EpisodeStore, mirror: Mirrored, count: int) -> NDArray[np.intp]:
    """Which of the first ``count`` episodes are shown in the mirror as well."""
    if mirror == "flights":
        flies = np.maximum.reduceat(store.passing[:, 3], store.start)
        return np.flatnonzero(flies[:count] > 0)
    return np.arange(count if mirror == "all" else 0)


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
    set_statistics(model, state_mean, state_std, returns, scaled, config.gamma)
