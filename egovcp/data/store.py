"""Episodes of one or several datasets as contiguous arrays in memory, with their targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import targets
from egovcp.data.episode import Episode
from egovcp.data.index import EpisodeIndex, fingerprint
from egovcp.data.reader import DatasetReader
from egovcp.data.returns import ReturnConfig
from egovcp.data.split import HELDOUT_FRACTION


@dataclass(frozen=True)
class EpisodeStore:
    """N frames of E episodes, one after the other."""

    depth: NDArray[np.uint16]
    """(N, 48, 64) mm."""
    state: NDArray[np.float32]
    """(N, 74)."""
    action: NDArray[np.float32]
    """(N, 7)."""
    prev_action: NDArray[np.float32]
    """(N, 7) action of the row before; zeros, the neutral pose, at the first row."""
    reward: NDArray[np.float32]
    """(N,)."""
    done: NDArray[np.bool_]
    """(N,)."""
    success: NDArray[np.bool_]
    """(N,)."""
    terminal_next: NDArray[np.bool_]
    """(N,) the row's action led to a failure."""
    mc_return: NDArray[np.float32]
    """(N,)."""
    mc_valid: NDArray[np.bool_]
    """(N,)."""
    start: NDArray[np.int64]
    """(E,) first frame of each episode."""
    length: NDArray[np.int64]
    """(E,) frames of each episode."""
    dataset: NDArray[np.int64]
    """(E,) which dataset each episode is of."""
    tasks: tuple[str, ...]
    """(E,) task of each episode; for sampling and reports, never for the network."""
    identities: tuple[str, ...]
    """(E,) what each episode is (see `DatasetReader.identity`)."""

    @classmethod
    def load(
        cls,
        readers: Sequence[DatasetReader],
        split: str = "all",
        returns: ReturnConfig | None = None,
        heldout_fraction: float = HELDOUT_FRACTION,
        per_task: int | None = None,
    ) -> Self:
        """Read the episodes of a split into memory (6.3 kB per frame, nearly all depth).

        Args:
            per_task: read at most this many episodes of each task, evenly spread over those of
                the split; None: all.

        Raises:
            DataError: the datasets cannot be mixed, are damaged, or the split is empty.
            UsageError: there is no such split.
        """
        index = EpisodeIndex.of(readers, split, heldout_fraction)
        return cls.read(index if per_task is None else index.spread(per_task), returns)

    @classmethod
    def read(cls, index: EpisodeIndex, returns: ReturnConfig | None = None) -> Self:
        """Read all episodes of an index into memory, each validated.

        Raises:
            DataError: a dataset is damaged.
        """
        store = cls.empty(index.length, index.dataset, index.tasks, index.identities)
        for number in range(len(index)):
            store.fill(number, index.read(number), returns or ReturnConfig())
        return store

    @classmethod
    def empty(
        cls,
        length: NDArray[np.int64],
        dataset: NDArray[np.int64],
        tasks: tuple[str, ...] = (),
        identities: tuple[str, ...] = (),
    ) -> Self:
        """Room for episodes of these lengths."""
        arrays = _allocate(int(length.sum()))
        start = length.cumsum() - length
        return cls(
            **arrays,
            start=start,
            length=length,
            dataset=dataset,
            tasks=tasks,
            identities=identities,
        )

    def fill(self, number: int, episode: Episode, config: ReturnConfig) -> None:
        """Write an episode and its targets to where episode ``number`` starts."""
        first = int(self.start[number])
        rows = slice(first, first + len(episode))
        for name in ("depth", "state", "action", "reward", "done", "success"):
            getattr(self, name)[rows] = getattr(episode, name)
        self.prev_action[first] = 0.0
        self.prev_action[first + 1 : rows.stop] = episode.action[:-1]
        self.terminal_next[rows] = targets.is_terminal(episode.done, episode.truncated)
        self.mc_return[rows] = targets.mc_return(episode.reward, config.gamma, config.steps)
        self.mc_valid[rows] = targets.mc_valid(
            len(episode), episode.time_limit, config.steps, config.keep_truncated
        )

    @property
    def num_frames(self) -> int:
        """Frames of all episodes."""
        return len(self.reward)

    @property
    def fingerprint(self) -> str:
        """Hash of which episodes these are, in order."""
        return fingerprint(self.identities, self.length)


def _allocate(frames: int) -> dict[str, NDArray[Any]]:
    pixels = (spec.DEPTH_ROWS, spec.DEPTH_COLS)
    return {
        "depth": np.empty((frames, *pixels), dtype=np.uint16),
        "state": np.empty((frames, spec.STATE_DIM), dtype=np.float32),
        "action": np.empty((frames, spec.ACTION_DIM), dtype=np.float32),
        "prev_action": np.empty((frames, spec.ACTION_DIM), dtype=np.float32),
        "reward": np.empty(frames, dtype=np.float32),
        "done": np.empty(frames, dtype=np.bool_),
        "success": np.empty(frames, dtype=np.bool_),
        "terminal_next": np.empty(frames, dtype=np.bool_),
        "mc_return": np.empty(frames, dtype=np.float32),
        "mc_valid": np.empty(frames, dtype=np.bool_),
    }
