"""The batches of `SequenceStream` from a few episodes at a time, whatever the dataset's size.

A shuffle window of slots holds episodes. Each gives as many windows of rows as cover it,
drawn in turn with those of the other slots, and then makes room for the next one. Every
draw comes from one generator; its state, the order's, and what the slots hold are the
state of the stream.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from egovcp.bounds import bounded, check_bounds
from egovcp.data.digests import Digests, comparing
from egovcp.data.index import EpisodeIndex
from egovcp.data.mix import Mix, group
from egovcp.data.order import EpisodeOrder, Shard
from egovcp.data.returns import ReturnConfig
from egovcp.data.store import EpisodeStore
from egovcp.data.stream import PLAIN, StreamConfig, require_same
from egovcp.data.windows import Batch, draw_mirrored, finish, gather
from egovcp.errors import DataError, UsageError

_ONE_SHARD: Final = Shard()


@dataclass(frozen=True)
class ShuffleConfig:
    """The episodes in memory."""

    episodes: int = bounded(128, least=1, most=1_000_000)
    """Episodes that are in memory at a time, about 1 MB each."""
    reuse: float = bounded(1.0, above=0)
    """How often the rows of an episode are used, on average, before the next one is read."""

    def check(self) -> None:
        """Raise `UsageError` for values that make no sense."""
        check_bounds(self, "shuffle.")


class BoundedStream:
    """Iterator over batches from an `EpisodeIndex`; the keys are those of `gather`."""

    def __init__(
        self,
        index: EpisodeIndex,
        config: StreamConfig,
        mix: Mix = PLAIN,
        shuffle: ShuffleConfig | None = None,
        shard: Shard = _ONE_SHARD,
        returns: ReturnConfig | None = None,
        checked: bool = True,
    ) -> None:
        """Make room; nothing is read before the first batch.

        Args:
            index: the episodes to draw from.
            config: how windows are drawn.
            mix: weights of datasets and tasks.
            shuffle: the episodes in memory.
            shard: the part of the episodes that this stream reads.
            returns: the Monte Carlo target.
            checked: all episodes have been validated; if not, each is when it is first read.

        Raises:
            UsageError: the configuration makes no sense.
        """
        self._shuffle = shuffle or ShuffleConfig()
        self._shuffle.check()
        config.check()
        self.index, self.config, self.mix, self.shard = index, config, mix, shard
        self._returns = returns or ReturnConfig()
        self._checked = np.full(len(index), checked)
        groups = group(mix, index.dataset, index.tasks, index.length)
        self._order = EpisodeOrder(index, groups, shard, config.seed)
        self._rng = np.random.default_rng([config.seed, shard.index])
        self._batches = 0
        slots = self._shuffle.episodes
        room = np.full(slots, int(index.length[self._order.episodes].max()))
        self._slots = EpisodeStore.empty(room, np.zeros(slots, dtype=np.int64))
        self._held: NDArray[np.int64] = np.full(slots, -1)  # episode in each slot
        self._left: NDArray[np.int64] = np.zeros(
            slots, dtype=np.int64
        )  # windows that it has still to give

    @property
    def episodes(self) -> NDArray[np.int64]:
        """The episodes of the index that this stream draws from."""
        return self._order.episodes

    def __iter__(self) -> Iterator[Batch]:
        return self

    def __next__(self) -> Batch:
        """The next batch.

        Raises:
            DataError: a file is damaged.
            EnvironmentFailure: the Hub, from which it comes, cannot be reached.
        """
        parts: list[Batch] = []
        wanted = self.config.batch_size
        while wanted:
            self._refill()
            tickets = np.repeat(np.arange(len(self._left)), self._left)
            slots = self._rng.choice(tickets, min(wanted, len(tickets)), replace=False)
            self._left -= np.bincount(slots, minlength=len(self._left))
            parts.append(self._windows(slots))
            wanted -= len(slots)
        batch = parts[0]
        if len(parts) > 1:
            batch = {key: np.concatenate([part[key] for part in parts]) for key in batch}
        self._batches += 1
        mirrored = draw_mirrored(self.config.batch_size, self.config.mirror, self._rng)
        return finish(batch, self.config.burn_in, mirrored)

    def state_dict(self) -> dict[str, Any]:
        """JSON-compatible state; a stream that loads it continues with exactly the next batch."""
        return {
            "rng": self._rng.bit_generator.state,
            "batches": self._batches,
            "order": self._order.state_dict(),
            "held": self._held.tolist(),
            "left": self._left.tolist(),
            "config": self._options(),
            "fingerprint": self.index.fingerprint,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> Self:
        """Continue where another stream over the same episodes stopped; reads its window again.

        Raises:
            DataError: the episodes differ, or a file is damaged.
            UsageError: the configuration differs.
        """
        if state["fingerprint"] != self.index.fingerprint:
            raise DataError("cannot resume the data stream: the dataset's episodes have changed")
        if "held" not in state:
            raise UsageError("cannot resume with a bounded stream what was in memory as a whole")
        require_same(state["config"], self._options())
        self._rng.bit_generator.state = state["rng"]
        self._batches = int(state["batches"])
        self._order.load_state_dict(state["order"])
        self._left = np.array(state["left"])
        with comparing() as digests:
            for slot, episode in enumerate(state["held"]):
                if episode >= 0 and self._left[slot]:
                    self._read(slot, episode, digests)
        self._held = np.array(state["held"])
        return self

    def _options(self) -> dict[str, Any]:
        parts = (vars(self.config), self.mix.as_dict(), vars(self._shuffle), vars(self.shard))
        return {name: value for part in parts for name, value in part.items()}

    def _refill(self) -> None:
        """Give every slot that is used up the next episode that has a window to give."""
        with comparing() as digests:
            for slot in np.flatnonzero(self._left == 0).tolist():
                episode = self._draw(slot)
                if self.index.is_remote:  # before it is read: other files need not wait for its own
                    self.index.expect(self._order.upcoming())
                self._read(slot, episode, digests)

    def _draw(self, slot: int) -> int:
        """The next episode that has a window to give."""
        while True:
            episode = self._order.draw(self._rng)
            windows = self.index.length[episode] * self._shuffle.reuse / self.config.length
            self._left[slot] = int(windows + self._rng.random())  # on average exactly so many
            if self._left[slot]:
                return episode

    def _read(self, slot: int, number: int, digests: Digests) -> None:
        index, store = self.index, self._slots
        checked = bool(self._checked[number])
        episode = index.read_again(number) if checked else index.read(number, digests)
        self._checked[number] = True
        store.dataset[slot] = self.index.dataset[number]
        store.fill(slot, episode, self._returns)
        store.length[slot] = len(episode)
        self._held[slot] = number

    def _windows(self, slots: NDArray[np.int64]) -> Batch:
        """A window of each of these slots, at a place that is drawn."""
        config, rng, store = self.config, self._rng, self._slots
        span = config.burn_in + config.length
        row = (rng.random(len(slots)) * store.length[slots]).astype(np.int64)
        place = rng.integers(config.burn_in, span, size=len(slots))
        latest = np.maximum(store.length[slots] - span, 0)
        first = np.clip(row - place, 0, latest)
        batch = gather(store, store.start[slots] + first, slots, span)
        batch["episode"] = self._held[slots]
        return batch
