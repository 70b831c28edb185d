"""Whole recorded episodes of one task at a time, with the pixels of what flies."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp.data import EpisodeStore
from egovcp.data.index import spread
from egovcp.data.windows import gather
from egovcp.model import Batch
from egovcp_train.batches import to_tensors
from egovcp_train.heldout.flight import flight_pixels
from egovcp_train.passing import PassingConfig

EPISODES_AT_ONCE = 16


class Recorded(NamedTuple):
    """Some whole episodes of one task, padded to the longest."""

    task: str
    batch: Batch
    ball: Tensor
    """(B, T, 48, 64) bool, see `flight_pixels`."""


def recorded(
    store: EpisodeStore, device: torch.device, config: PassingConfig, per_task: int | None = None
) -> Iterator[Recorded]:
    """The episodes, task by task, each as a robot lives through it, from its start.

    Args:
        per_task: at most this many episodes of each task, evenly spread; None: all.
    """
    for task in sorted(set(store.tasks)):
        own = np.flatnonzero(np.array(store.tasks) == task)
        own = spread(own, per_task)
        own = own[np.argsort(store.length[own], kind="stable")]  # little padding
        for first in range(0, len(own), EPISODES_AT_ONCE):
            which = own[first : first + EPISODES_AT_ONCE]
            yield _together(task, store, which, device, config)


def _together(
    task: str,
    store: EpisodeStore,
    which: NDArray[np.intp],
    device: torch.device,
    config: PassingConfig,
) -> Recorded:
    span = int(store.length[which].max())
    batch = to_tensors(gather(store, store.start[which], which, span), device)
    ball = np.zeros(batch.depth.shape, dtype=np.bool_)
    for row, episode in enumerate(which):
        length = int(store.length[episode])
        rows = slice(store.start[episode], store.start[episode] + length)
        ball[row, :length] = flight_pixels(store.depth[rows], store.state[rows], config)
    return Recorded(task, batch, torch.from_numpy(ball).to(device))
