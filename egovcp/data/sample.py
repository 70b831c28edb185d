"""Episodes that stand for all of a dataset on the Hub, from few of its files."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from egovcp.data.index import EpisodeIndex, spread


def sample_files(
    learning: EpisodeIndex, heldout: EpisodeIndex, files: int
) -> tuple[EpisodeIndex, EpisodeIndex]:
    """The training and the held-out episodes that lie in a few files, the same ones if possible.

    Of a dataset that is on disk all are kept; of one on the Hub those in at most ``files`` files
    of each task, evenly spread.
    """
    return _sample(learning, heldout, files), _sample(heldout, learning, files)


def _sample(index: EpisodeIndex, other: EpisodeIndex, files: int) -> EpisodeIndex:
    shared = set(_places(other))
    own = _places(index)
    kept = np.zeros(len(index), dtype=np.bool_)
    for task, dataset in sorted({(task, dataset) for task, dataset, _ in own}):
        numbers = sorted({f for t, d, f in own if (t, d) == (task, dataset)})
        if index.readers[dataset].is_remote:
            common = [f for f in numbers if (task, dataset, f) in shared]
            numbers = _spread(common or numbers, files)
        wanted = {(task, dataset, f) for f in numbers}
        kept |= np.array([place in wanted for place in own])
    return index.select(np.flatnonzero(kept))


def _places(index: EpisodeIndex) -> list[tuple[str, int, str]]:
    """Task, dataset and file of each episode."""
    files: Iterator[str] = (path.as_posix() for path in index.files)
    return list(zip(index.tasks, index.dataset.tolist(), files, strict=True))


def _spread(names: list[str], limit: int) -> list[str]:
    chosen: NDArray[np.intp] = spread(np.arange(len(names)), limit)
    return [names[i] for i in chosen]
