"""Episodes of one or several datasets as contiguous arrays in memory, with their targets."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import targets
from egovcp.data.episode import Episode
from egovcp.data.reader import DatasetReader
from egovcp.data.split import HELDOUT_FRACTION, in_split
from egovcp.errors import DataError


@dataclass(frozen=True)
class ReturnConfig:
    """The Monte Carlo target of Q."""

    gamma: float = spec.GAMMA
    """Discount per planner tick."""
    steps: int = spec.RETURN_STEPS
    """Horizon K, planner ticks."""
    keep_truncated: bool = False
    """Train on returns that the time limit cuts short, too (the paper's choice)."""


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
    passing: NDArray[np.float32]
    """(N, 5) what is on its way: where it will pass the plane before the robot (y, z in m) and
    in how long (s), whether anything is, and whether that is known; zeros, not known, until
    somebody labels them."""
    start: NDArray[np.int64]
    """(E,) first frame of each episode."""
    length: NDArray[np.int64]
    """(E,) frames of each episode."""
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
        require_mixable(readers)
        episodes = [(reader, index) for reader in readers for index in range(len(reader))]
        identities = [reader.identity(index) for reader, index in episodes]
        chosen = list(compress(episodes, in_split(identities, split, heldout_fraction)))
        if not chosen:
            raise DataError(
                f"none of the {len(episodes)} episodes falls into split {split!r}; collect more"
            )
        if per_task is not None:
            chosen = _spread(chosen, per_task)
        length = np.array([reader.lengths[index] for reader, index in chosen], dtype=np.int64)
        arrays = _allocate(int(length.sum()))
        start = length.cumsum() - length
        for (reader, index), first in zip(chosen, start, strict=True):
            _fill(arrays, int(first), reader.read(index), returns or ReturnConfig())
        return cls(
            **arrays,
            start=start,
            length=length,
            tasks=tuple(reader.task(index) for reader, index in chosen),
            identities=tuple(reader.identity(index) for reader, index in chosen),
        )

    @property
    def num_frames(self) -> int:
        """Frames of all episodes."""
        return len(self.reward)

    @property
    def fingerprint(self) -> str:
        """Hash of which episodes these are, in order."""
        text = "\n".join(f"{i} {n}" for i, n in zip(self.identities, self.length, strict=True))
        return hashlib.sha256(text.encode()).hexdigest()


def require_mixable(readers: Sequence[DatasetReader]) -> None:
    """Raise `DataError` unless all datasets share controller and rate."""
    if not readers:
        raise DataError("no dataset given")
    first = readers[0]
    for other in readers[1:]:
        for what in ("controller_id", "fps"):
            have, want = getattr(other, what), getattr(first, what)
            if have != want:
                raise DataError(
                    f"{other.root} has {what} {have}, {first.root} has {want}; such datasets do "
                    "not mix"
                )


def _spread(
    episodes: list[tuple[DatasetReader, int]], per_task: int
) -> list[tuple[DatasetReader, int]]:
    """At most ``per_task`` episodes of each task, evenly spread, in their order."""
    of_task: dict[str, list[int]] = {}
    for place, (reader, index) in enumerate(episodes):
        of_task.setdefault(reader.task(index), []).append(place)
    kept = [
        places[i]
        for places in of_task.values()
        for i in np.linspace(0, len(places) - 1, min(per_task, len(places))).round().astype(int)
    ]
    return [episodes[place] for place in sorted(kept)]


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
        "passing": np.zeros((frames, spec.PASSING_DIM), dtype=np.float32),
    }


def _fill(
    arrays: dict[str, NDArray[Any]], first: int, episode: Episode, config: ReturnConfig
) -> None:
    rows = slice(first, first + len(episode))
    for name in ("depth", "state", "action", "reward", "done", "success"):
        arrays[name][rows] = getattr(episode, name)
    arrays["prev_action"][first] = 0.0
    arrays["prev_action"][first + 1 : rows.stop] = episode.action[:-1]
    arrays["terminal_next"][rows] = targets.is_terminal(episode.done, episode.truncated)
    arrays["mc_return"][rows] = targets.mc_return(episode.reward, config.gamma, config.steps)
    arrays["mc_valid"][rows] = targets.mc_valid(
        len(episode), episode.time_limit, config.steps, config.keep_truncated
    )
