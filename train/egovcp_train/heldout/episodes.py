"""Whole recorded episodes of one task at a time, with the pixels of what flies."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp import spec
from egovcp.data import EpisodeStore
from egovcp.data.index import spread
from egovcp.data.windows import gather
from egovcp.model import Batch
from egovcp.model.depth import nearness, thing_pixels
from egovcp_train.batches import to_tensors

EPISODES_AT_ONCE = 16


class Recorded(NamedTuple):
    """Some whole episodes of one task, padded to the longest."""

    task: str
    batch: Batch
    ball: Tensor
    """(B, T, 48, 64) bool, the pixels of what flies, see `egovcp_train.labels.flight`."""


def recorded(
    store: EpisodeStore, device: torch.device, per_task: int | None = None
) -> Iterator[Recorded]:
    """The episodes, task by task, each as a robot lives through it, from its start.

    Args:
        store: labelled episodes (`egovcp_train.labels.passing`).
        device: where to put them.
        per_task: at most this many episodes of each task, evenly spread; None: all.
    """
    for task in sorted(set(store.tasks)):
        own = np.flatnonzero(np.array(store.tasks) == task)
        own = spread(own, per_task)
        own = own[np.argsort(store.length[own], kind="stable")]  # little padding
        for first in range(0, len(own), EPISODES_AT_ONCE):
            which = own[first : first + EPISODES_AT_ONCE]
            yield _together(task, store, which, device)


def _together(
    task: str, store: EpisodeStore, which: NDArray[np.intp], device: torch.device
) -> Recorded:
    span = int(store.length[which].max())
    batch = to_tensors(gather(store, store.start[which], which, span), device)
    near = nearness(batch.depth.flatten(0, 1), spec.DEPTH_MAX_M)
    place = batch.passing[..., spec.IN_PICTURE].flatten(0, 1)
    ball = thing_pixels(near, place, spec.DEPTH_MAX_M).view(batch.depth.shape)
    return Recorded(task, batch, ball & batch.valid[..., None, None])
