"""Endless training batches ``[B, T, ...]`` of windows of episodes, exactly resumable.

A window is placed by drawing a row and its place within the window, then moving the
window inside the episode: all rows are covered, the first and the last ones (where
memory starts from nothing, and where falls are) somewhat more often. Only an episode
shorter than the window is padded. Every draw comes from one generator, whose state is
the state of the stream.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from egovcp.data.mix import Mix, Pools, group
from egovcp.data.store import EpisodeStore
from egovcp.data.windows import Batch, draw_mirrored, finish, gather
from egovcp.errors import DataError, UsageError

PLAIN: Final = Mix()  # no weights
ALL_ROWS: Final = slice(None)


@dataclass(frozen=True)
class StreamConfig:
    """How windows are drawn."""

    batch_size: int = 16
    """Windows per batch, B."""
    length: int = 48
    """Rows that count in each window."""
    burn_in: int = 0
    """Rows before them that only warm up the memory: valid only where the episode starts."""
    mirror: bool = True
    """Reflect half of the windows left to right."""
    seed: int = 0
    """Seed of all draws."""

    def check(self) -> None:
        """Raise `UsageError` for values that make no sense."""
        if self.batch_size < 1 or self.length < 1 or self.burn_in < 0:
            raise UsageError(
                f"batch_size {self.batch_size}, length {self.length}, burn_in {self.burn_in}: "
                "expected at least 1, 1 and 0"
            )


class SequenceStream:
    """Iterator over batches from an `EpisodeStore`."""

    def __init__(
        self,
        store: EpisodeStore,
        config: StreamConfig,
        mix: Mix = PLAIN,
        rows: slice = ALL_ROWS,
    ) -> None:
        """Seed the generator.

        Args:
            store: the episodes.
            config: how windows are drawn.
            mix: weights of datasets and tasks.
            rows: which windows of each batch to make. Processes that train together draw the
                same batch, in the same state, and make a part of it each.

        Raises:
            UsageError: the configuration makes no sense.
        """
        config.check()
        self.store = store
        self.config = config
        self.mix = mix
        self._rows = rows
        self._rng = np.random.default_rng(config.seed)
        self._batches = 0
        self._fingerprint = store.fingerprint
        self._episode_of = np.repeat(np.arange(len(store.length)), store.length)
        self._groups = group(mix, store.dataset, store.tasks, store.length)
        of_rows, count = self._groups.of[self._episode_of], len(self._groups.share)
        self._row_pools = Pools(np.arange(store.num_frames), of_rows, count)

    def __iter__(self) -> Iterator[Batch]:
        return self

    def __next__(self) -> Batch:
        """The next batch; keys as in `gather`, ``valid`` false where a row must not count."""
        config, rng = self.config, self._rng
        start, episode = self._draw_windows()
        mirrored = draw_mirrored(config.batch_size, config.mirror, rng)
        own = self._rows
        batch = gather(self.store, start[own], episode[own], config.burn_in + config.length)
        self._batches += 1
        return finish(batch, config.burn_in, mirrored[own])

    def state_dict(self) -> dict[str, Any]:
        """JSON-compatible state; a stream that loads it continues with exactly the next batch."""
        return {
            "rng": self._rng.bit_generator.state,
            "batches": self._batches,
            "config": vars(self.config).copy(),
            "mix": self.mix.as_dict(),
            "fingerprint": self._fingerprint,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> Self:
        """Continue where another stream over the same episodes stopped.

        Raises:
            DataError: the episodes differ.
            UsageError: the configuration differs.
        """
        if state["fingerprint"] != self._fingerprint:
            raise DataError("cannot resume the data stream: the dataset's episodes have changed")
        if "held" in state:
            raise UsageError("cannot resume in memory as a whole what was a bounded stream")
        require_same(state["config"], vars(self.config))
        require_same(state.get("mix", PLAIN.as_dict()), self.mix.as_dict())
        self._rng.bit_generator.state = state["rng"]
        self._batches = int(state["batches"])
        return self

    def _draw_windows(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First frame and episode of each window, (B,) each."""
        config, rng, store = self.config, self._rng, self.store
        span = config.burn_in + config.length
        rows = self._draw_rows() if self.mix.is_plain else self._draw_mixed_rows()
        episode = self._episode_of[rows]
        place = rng.integers(config.burn_in, span, size=config.batch_size)
        first = store.start[episode]
        latest = first + np.maximum(store.length[episode] - span, 0)
        return np.clip(rows - place, first, latest), episode

    def _draw_rows(self) -> NDArray[np.int64]:
        """A row for each window, (B,), all equally likely."""
        return self._rng.integers(self.store.num_frames, size=self.config.batch_size)

    def _draw_mixed_rows(self) -> NDArray[np.int64]:
        """A row for each window, (B,): first its group, then a row of that group."""
        share = self._groups.share
        groups = self._rng.choice(len(share), size=self.config.batch_size, p=share)
        return self._row_pools.pick(self._rng, groups)


def require_same(then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise `UsageError` unless a resumed stream has the options that it had."""
    changed = [f"{k} {then.get(k)} -> {v}" for k, v in now.items() if then.get(k) != v]
    if changed:
        raise UsageError(f"cannot resume the data stream with {', '.join(changed)}")
