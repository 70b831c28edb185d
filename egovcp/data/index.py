"""Which episodes of one or several datasets a split consists of; their content stays on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp.data.columns import EPISODE_FEATURES
from egovcp.data.digests import Digests
from egovcp.data.episode import Episode
from egovcp.data.reader import DatasetReader
from egovcp.data.split import HELDOUT_FRACTION, in_split
from egovcp.errors import DataError


@dataclass(frozen=True)
class EpisodeIndex:
    """E episodes, numbered in the order of their datasets."""

    readers: tuple[DatasetReader, ...]
    """The datasets."""
    dataset: NDArray[np.int64]
    """(E,) which of the datasets holds each episode."""
    number: NDArray[np.int64]
    """(E,) the number of each episode there."""

    @classmethod
    def of(
        cls,
        readers: Sequence[DatasetReader],
        split: str = "all",
        heldout_fraction: float = HELDOUT_FRACTION,
    ) -> Self:
        """The episodes of a split, of those that are asked for.

        Raises:
            DataError: the datasets cannot be mixed, or the split is empty.
            UsageError: there is no such split.
        """
        require_mixable(readers)
        places = [(d, i) for d, reader in enumerate(readers) for i in reader.chosen.tolist()]
        identities = [readers[d].identity(i) for d, i in places]
        chosen = list(compress(places, in_split(identities, split, heldout_fraction)))
        if not chosen:
            raise DataError(
                f"none of the {len(places)} episodes falls into split {split!r}: collect more, or "
                "name other datasets beside them"
            )
        dataset, number = np.array(chosen, dtype=np.int64).T
        return cls(tuple(readers), dataset, number)

    def __len__(self) -> int:
        return len(self.number)

    def spread(self, per_task: int) -> EpisodeIndex:
        """At most ``per_task`` episodes of each task, evenly spread, in their order."""
        tasks = np.array(self.tasks)
        kept = [spread(np.flatnonzero(tasks == task), per_task) for task in sorted(set(tasks))]
        return self.select(np.sort(np.concatenate(kept)))

    def select(self, episodes: NDArray[np.int64]) -> EpisodeIndex:
        """Some of its episodes."""
        return EpisodeIndex(self.readers, self.dataset[episodes], self.number[episodes])

    @cached_property
    def length(self) -> NDArray[np.int64]:
        """(E,) frames of each episode."""
        lengths = [reader.lengths for reader in self.readers]
        return np.array([lengths[d][i] for d, i in self._places], dtype=np.int64)

    @property
    def num_frames(self) -> int:
        """Frames of all episodes."""
        return int(self.length.sum())

    @property
    def tasks(self) -> tuple[str, ...]:
        """(E,) task of each episode; for sampling and reports, never for the network."""
        return tuple(self.readers[d].task(i) for d, i in self._places)

    @property
    def identities(self) -> tuple[str, ...]:
        """(E,) what each episode is (see `DatasetReader.identity`)."""
        return tuple(self.readers[d].identity(i) for d, i in self._places)

    @property
    def files(self) -> tuple[Path, ...]:
        """(E,) the file that holds each episode."""
        return tuple(self.readers[d].data_path(i) for d, i in self._places)

    @cached_property
    def fingerprint(self) -> str:
        """Hash of which episodes these are, in order."""
        return fingerprint(self.identities, self.length)

    @property
    def is_remote(self) -> bool:
        """Whether some of the episodes come from the Hub as they are read."""
        return any(reader.is_remote for reader in self.readers)

    def bring(self) -> None:
        """Have the files of all its episodes here.

        Raises:
            DataError: a dataset on the Hub is incomplete.
            EnvironmentFailure: the Hub cannot be reached, or refuses.
        """
        one_of_each = dict(zip(self.files, range(len(self)), strict=True)).values()
        for episode in tqdm(one_of_each, unit="file", desc="fetch", leave=False):
            reader, number = self._place(episode)
            reader.bring(number)

    def expect(self, episodes: Sequence[int]) -> None:
        """Say which episodes are read next, so that their files come meanwhile."""
        for reader in self.readers:
            if reader.is_remote:
                places = map(self._place, episodes)
                reader.expect([number for other, number in places if other is reader])

    def read(self, episode: int, digests: Digests | None = None) -> Episode:
        """Read one episode and validate it (see `DatasetReader.read`).

        Raises:
            DataError: the file is damaged or its content violates the specification.
        """
        reader, number = self._place(episode)
        return reader.read(number, digests)

    def read_again(self, episode: int) -> Episode:
        """Read one episode that has been validated before.

        Raises:
            DataError: the file is damaged.
        """
        reader, number = self._place(episode)
        columns = reader.read_episode_columns(number, tuple(EPISODE_FEATURES.values()))
        return Episode(
            **{name: columns[key] for name, key in EPISODE_FEATURES.items()},
            task=reader.task(number),
            time_limit=reader.time_limit(number),
            metadata=reader.metadata(number),
        )

    def _place(self, episode: int) -> tuple[DatasetReader, int]:
        return self.readers[int(self.dataset[episode])], int(self.number[episode])

    @property
    def _places(self) -> list[tuple[int, int]]:
        return list(zip(self.dataset.tolist(), self.number.tolist(), strict=True))


def spread(places: NDArray[np.intp], limit: int | None) -> NDArray[np.intp]:
    """At most ``limit`` of the places, evenly spread over them."""
    if limit is None or limit >= len(places):
        return places
    return places[np.linspace(0, len(places) - 1, limit).round().astype(np.intp)]


def fingerprint(identities: Sequence[str], length: NDArray[np.int64]) -> str:
    """Hash of which episodes these are, in order."""
    text = "\n".join(f"{i} {n}" for i, n in zip(identities, length, strict=True))
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
