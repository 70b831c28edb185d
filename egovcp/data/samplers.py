"""Endless training batches ``[B, T, ...]`` of windows of episodes, exactly resumable.

A window is placed by drawing a row and its position within the window, then moving the
window inside the episode: all rows are covered, the first and the last ones (where
memory starts from nothing, and where falls are) somewhat more often. Only an episode
shorter than the window is padded. All draws of a sampler come from one generator.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from threading import Thread
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from egovcp.bounds import bounded, check_bounds
from egovcp.data.index import EpisodeIndex
from egovcp.data.order import EpisodeOrder, Mix, group_episodes
from egovcp.data.returns import ReturnConfig
from egovcp.data.store import Batch, EpisodeStore, gather, mirror_windows
from egovcp.errors import DataError, UsageError
from egovcp.robot_spec import RobotSpec

NO_WEIGHTS: Final = Mix()


@dataclass(frozen=True)
class SamplerConfig:
    """How windows are drawn."""

    batch_size: int = bounded(16, least=1)
    """Windows per batch, B."""
    length: int = bounded(48, least=1)
    """Rows of each window for which losses are computed."""
    burn_in: int = bounded(0, least=0)
    """Rows before them that only warm up the memory: valid only where the episode starts."""
    mirror: bool = True
    """Reflect half of the windows left to right."""
    seed: int = 0
    """Seed of all draws."""

    def check(self) -> None:
        check_bounds(self)

    @property
    def span(self) -> int:
        """Rows of a window, T."""
        return self.burn_in + self.length


@dataclass(frozen=True)
class ShuffleConfig:
    """The shuffle buffer of episodes in memory."""

    episodes: int = bounded(128, least=1, most=1_000_000)
    """Episodes in memory, about 1 MB each."""
    reuse: float = bounded(1.0, least=0.01)
    """How often the rows of an episode are used, on average, before it is replaced."""

    def check(self) -> None:
        check_bounds(self, "shuffle.")


class InMemorySampler:
    """Iterator over batches from an `EpisodeStore`."""

    def __init__(self, store: EpisodeStore, config: SamplerConfig, mix: Mix = NO_WEIGHTS) -> None:
        config.check()
        self.store, self.config, self.mix = store, config, mix
        self._rng = np.random.default_rng(config.seed)
        self._fingerprint = store.fingerprint
        self._episode_of = np.repeat(np.arange(len(store.length)), store.length)
        groups = group_episodes(mix, store.dataset, store.tasks, store.length)
        group = groups.of[self._episode_of]
        cumulative = (groups.share / np.bincount(group))[group].cumsum()
        self._cumulative = cumulative / cumulative[-1]  # probability of each row and those before

    def __iter__(self) -> Iterator[Batch]:
        return self

    def __next__(self) -> Batch:
        """The next batch; keys as in `gather`, ``valid`` is false for rows without loss."""
        config, rng, store = self.config, self._rng, self.store
        rows = self._draw_rows()
        episode = self._episode_of[rows]
        offset = rng.integers(config.burn_in, config.span, size=config.batch_size)
        first = store.start[episode]
        latest = first + np.maximum(store.length[episode] - config.span, 0)
        start = np.clip(rows - offset, first, latest)
        batch = gather(store, start, episode, config.span)
        return _finish(batch, config, rng, store.robot)

    def state_dict(self) -> dict[str, Any]:
        """JSON-compatible state; a sampler that loads it continues with exactly the next batch."""
        return {
            "rng": self._rng.bit_generator.state,
            "config": vars(self.config).copy(),
            "mix": self.mix.as_dict(),
            "fingerprint": self._fingerprint,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> Self:
        """Continue from the state of a sampler with the same episodes and configuration."""
        _require_same_episodes(state, self._fingerprint)
        if "held" in state:
            raise UsageError(
                "cannot resume in memory: the run has streamed its data; use --loading.mode=stream"
            )
        _require_same_options(state["config"], vars(self.config))
        _require_same_options(state.get("mix", NO_WEIGHTS.as_dict()), self.mix.as_dict())
        self._rng.bit_generator.state = state["rng"]
        return self

    def _draw_rows(self) -> NDArray[np.int64]:
        """A row for each window, (B,): all equally likely, or by the weights of their groups."""
        size = self.config.batch_size
        if self.mix.is_plain:
            return self._rng.integers(self.store.num_frames, size=size)
        rows = np.searchsorted(self._cumulative, self._rng.random(size), side="right")
        return rows.astype(np.int64)


class StreamingSampler:
    """Iterator over batches from an `EpisodeIndex` of any size.

    A shuffle buffer of slots holds episodes. Each yields as many windows as cover it, drawn in
    random order with those of the other slots, and is then replaced by the next episode.
    """

    def __init__(
        self,
        index: EpisodeIndex,
        config: SamplerConfig,
        mix: Mix = NO_WEIGHTS,
        shuffle: ShuffleConfig | None = None,
        returns: ReturnConfig | None = None,
        checked: bool = True,
    ) -> None:
        """Allocate the buffer; nothing is read before the first batch.

        Args:
            checked: all episodes were validated; if not, each is validated when it is first read.
        """
        self._shuffle = shuffle or ShuffleConfig()
        self._shuffle.check()
        config.check()
        self.index, self.config, self.mix = index, config, mix
        self._returns = returns or ReturnConfig()
        self._checked = np.full(len(index), checked)
        groups = group_episodes(mix, index.dataset, index.tasks, index.length)
        self._order = EpisodeOrder(index, groups, config.seed)
        self._rng = np.random.default_rng(config.seed)
        slots = self._shuffle.episodes
        capacity = np.full(slots, int(index.length[groups.share[groups.of] > 0].max()))
        none = np.zeros(slots, dtype=np.int64)
        self._slots = EpisodeStore.empty(capacity, none, robot=index.robot)
        self._held: NDArray[np.int64] = np.full(slots, -1)  # episode in each slot
        self._left = np.zeros(slots, dtype=np.int64)  # windows that each slot has still to yield

    def __iter__(self) -> Iterator[Batch]:
        return self

    def __next__(self) -> Batch:
        """The next batch; keys as in `gather`, ``valid`` is false for rows without loss."""
        parts: list[Batch] = []
        wanted = self.config.batch_size
        while wanted:
            self._refill()
            tickets = np.repeat(np.arange(len(self._left)), self._left)
            slots = self._rng.choice(tickets, min(wanted, len(tickets)), replace=False)
            self._left -= np.bincount(slots, minlength=len(self._left))
            parts.append(self._draw_windows(slots))
            wanted -= len(slots)
        batch = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        return _finish(batch, self.config, self._rng, self.index.robot)

    def state_dict(self) -> dict[str, Any]:
        """JSON-compatible state; a sampler that loads it continues with exactly the next batch."""
        return {
            "rng": self._rng.bit_generator.state,
            "order": self._order.state_dict(),
            "held": self._held.tolist(),
            "left": self._left.tolist(),
            "config": self._options(),
            "fingerprint": self.index.fingerprint,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> Self:
        """Continue from the state of a sampler with the same episodes and configuration."""
        _require_same_episodes(state, self.index.fingerprint)
        if "held" not in state:
            raise UsageError(
                "cannot resume by streaming: the run had its data in memory; use --loading.mode=ram"
            )
        _require_same_options(state["config"], self._options())
        self._rng.bit_generator.state = state["rng"]
        self._order.load_state_dict(state["order"])
        self._left = np.array(state["left"])
        for slot, episode in enumerate(state["held"]):
            if episode >= 0 and self._left[slot]:
                self._read(slot, episode)
        self._held = np.array(state["held"])
        return self

    def _options(self) -> dict[str, Any]:
        return vars(self.config) | self.mix.as_dict() | vars(self._shuffle)

    def _refill(self) -> None:
        """Replace the episode of every slot that has no window left."""
        for slot in np.flatnonzero(self._left == 0).tolist():
            episode = self._draw_episode(slot)
            if self.index.is_remote:  # before the read, so that other files are not delayed by it
                self.index.prefetch(self._order.upcoming())
            self._read(slot, episode)

    def _draw_episode(self, slot: int) -> int:
        """The next episode that yields at least one window."""
        while True:
            episode = self._order.draw(self._rng)
            windows = self.index.length[episode] * self._shuffle.reuse / self.config.length
            self._left[slot] = int(windows + self._rng.random())  # the mean is exact
            if self._left[slot]:
                return episode

    def _read(self, slot: int, number: int) -> None:
        index, store = self.index, self._slots
        episode = index.read_unchecked(number) if self._checked[number] else index.read(number)
        self._checked[number] = True
        store.dataset[slot] = index.dataset[number]
        store.fill(slot, episode, self._returns)
        store.length[slot] = len(episode)
        self._held[slot] = number

    def _draw_windows(self, slots: NDArray[np.int64]) -> Batch:
        """A window at a random place of each of these slots."""
        config, rng, store = self.config, self._rng, self._slots
        row = (rng.random(len(slots)) * store.length[slots]).astype(np.int64)
        offset = rng.integers(config.burn_in, config.span, size=len(slots))
        latest = np.maximum(store.length[slots] - config.span, 0)
        first = np.clip(row - offset, 0, latest)
        batch = gather(store, store.start[slots] + first, slots, config.span)
        batch["episode"] = self._held[slots]
        return batch


class PrefetchIterator:
    """The batches of ``sampler``, each made in a thread while the one before is used.

    The state is that after the last batch that was returned, not the last one that was made.
    """

    def __init__(self, sampler: InMemorySampler | StreamingSampler) -> None:
        """``sampler`` must not be used otherwise; the first batch is made on the first call."""
        self._sampler = sampler
        self._state = sampler.state_dict()
        self._pending: Future[tuple[Batch, dict[str, Any]]] | None = None

    def __iter__(self) -> Iterator[Batch]:
        return self

    def __next__(self) -> Batch:
        """The next batch; raises the errors of the sampler."""
        pending = self._pending or self._start()
        batch, self._state = pending.result()
        self._pending = self._start()
        return batch

    def state_dict(self) -> dict[str, Any]:
        """State of the sampler after the last batch that was returned."""
        return self._state

    def load_state_dict(self, state: Mapping[str, Any]) -> Self:
        """Continue from the state of another sampler; the prefetched batch is dropped."""
        if self._pending is not None:
            self._pending.exception()  # waits; an error of the dropped batch is ignored
            self._pending = None
        self._sampler.load_state_dict(state)
        self._state = self._sampler.state_dict()
        return self

    def _start(self) -> Future[tuple[Batch, dict[str, Any]]]:
        """Make the next batch in a daemon thread: the process may end while it waits for a file."""
        pending: Future[tuple[Batch, dict[str, Any]]] = Future()
        Thread(target=self._make, args=(pending,), name="batches", daemon=True).start()
        return pending

    def _make(self, pending: Future[tuple[Batch, dict[str, Any]]]) -> None:
        try:
            pending.set_result((next(self._sampler), self._sampler.state_dict()))
        except BaseException as error:  # noqa: BLE001 - raised by the future
            pending.set_exception(error)


def _finish(
    batch: Batch, config: SamplerConfig, rng: np.random.Generator, robot: RobotSpec
) -> Batch:
    """Mask the burn-in of a batch, unless an episode starts there, and reflect half of it if the
    robot is symmetric."""
    batch["valid"] &= ~((np.arange(config.span) < config.burn_in) & (batch["t"][:, :1] > 0))
    if config.mirror and robot.mirror is not None:
        mirrored = rng.random(config.batch_size) < 0.5
        mirror_windows(batch, np.flatnonzero(mirrored), robot)
    return batch


def _require_same_episodes(state: Mapping[str, Any], fingerprint: str) -> None:
    if state["fingerprint"] != fingerprint:
        raise DataError(
            "cannot resume the data stream: the dataset's episodes have changed; restore the "
            "dataset, or start a new run"
        )


def _require_same_options(then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise `UsageError` unless a resumed sampler has the options of the saved one."""
    changed = [f"{k} {then.get(k)} -> {v}" for k, v in now.items() if then.get(k) != v]
    if changed:
        raise UsageError(
            f"cannot resume the data stream with {', '.join(changed)}; give the options of the "
            "run, or start a new one"
        )
