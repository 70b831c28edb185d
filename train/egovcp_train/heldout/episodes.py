"""Batches of whole recorded episodes, one task at a time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from egovcp.data import EpisodeStore
from egovcp.data.index import evenly_spaced
from egovcp.data.store import gather
from egovcp.model import Batch
from egovcp_train.batches import to_tensors

EPISODES_AT_ONCE = 16


class Recorded(NamedTuple):
    """Some whole episodes of one task, padded to the longest."""

    task: str
    batch: Batch


def recorded(
    store: EpisodeStore, device: torch.device, per_task: int | None = None
) -> Iterator[Recorded]:
    """The episodes from their first row, task by task.

    Args:
        store: the episodes.
        device: of the tensors.
        per_task: at most this many episodes of each task, evenly spread; None: all.
    """
    for task in sorted(set(store.tasks)):
        own = np.flatnonzero(np.array(store.tasks) == task)
        own = evenly_spaced(own, per_task)
        own = own[np.argsort(store.length[own], kind="stable")]  # little padding
        for first in range(0, len(own), EPISODES_AT_ONCE):
            which = own[first : first + EPISODES_AT_ONCE]
            span = int(store.length[which].max())
            batch = gather(store, store.start[which], which, span)
            yield Recorded(task, to_tensors(batch, device))
