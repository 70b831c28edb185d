"""The episodes of a split of one or several datasets; their arrays stay on disk.

Held-out episodes are chosen by a hash of the episode's identity (task, seed, number). The choice
depends on neither order nor number of episodes, so a dataset that is extended, merged or read in
part keeps the same episodes out of training, except in datasets so small that the rule selects
none: then the episode with the lowest hash is held out, and may change when the dataset grows.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp import spec
from egovcp.data.episode import Episode
from egovcp.data.parquet import EPISODE_FEATURES
from egovcp.data.reader import DatasetReader
from egovcp.errors import DataError, UsageError, suggest
from egovcp.robot_spec import RobotSpec

SPLITS: Final = ("train", "heldout", "all")
HELDOUT_FRACTION: Final = 0.05
MAX_LISTED: Final = 5000  # episode numbers
RULE: Final = (
    "an episode is held out if v / 2**64 < fraction, where v is the big-endian uint64 of the first "
    "8 bytes of SHA-256('task/seed/episode'); if that selects none of at least two, the one with "
    "the lowest v is"
)


def in_split(identities: Sequence[str], split: str) -> list[bool]:
    """Whether each of the episodes with these identities belongs to ``split`` (see `RULE`).

    Raises:
        UsageError: unknown split.
    """
    if split not in SPLITS:
        raise UsageError(f"unknown split {split!r}{suggest(split, SPLITS)}")
    if split == "all" or not identities:
        return [True] * len(identities)
    hashes = [_hash_fraction(identity) for identity in identities]
    bound, lowest = HELDOUT_FRACTION, min(hashes)
    if lowest >= bound:
        bound = min((value for value in hashes if value > lowest), default=bound)
    return [(value < bound) == (split == "heldout") for value in hashes]


def _hash_fraction(identity: str) -> float:
    digest = hashlib.sha256(identity.encode()).digest()
    return int.from_bytes(digest[:8], "big") / 2**64


@dataclass(frozen=True)
class EpisodeIndex:
    """E episodes, numbered in the order of their datasets."""

    readers: tuple[DatasetReader, ...]
    """The datasets."""
    dataset: NDArray[np.int64]
    """(E,) dataset of each episode, an index into `readers`."""
    number: NDArray[np.int64]
    """(E,) number of each episode in its dataset."""

    @classmethod
    def of(cls, readers: Sequence[DatasetReader], split: str = "all") -> Self:
        """The selected episodes of the datasets that belong to a split.

        Raises:
            UsageError: unknown split.
            DataError: the datasets cannot be mixed, or the split is empty.
        """
        require_mixable(readers)
        places = [(d, i) for d, reader in enumerate(readers) for i in reader.selected.tolist()]
        identities = [readers[d].identity(i) for d, i in places]
        chosen = list(compress(places, in_split(identities, split)))
        if not chosen:
            raise DataError(
                f"none of the {len(places)} episodes falls into split {split!r}: collect more, "
                "add other datasets, or select more with --dataset.episodes"
            )
        dataset, number = np.array(chosen, dtype=np.int64).T
        return cls(tuple(readers), dataset, number)

    def __len__(self) -> int:
        return len(self.number)

    def subsample(self, per_task: int) -> EpisodeIndex:
        """At most ``per_task`` episodes of each task, evenly spaced, in order."""
        tasks = np.array(self.tasks)
        kept = [evenly_spaced(np.flatnonzero(tasks == t), per_task) for t in sorted(set(tasks))]
        return self.select(np.sort(np.concatenate(kept)))

    def select(self, episodes: NDArray[np.int64]) -> EpisodeIndex:
        """The index of these of its episodes, in the order given."""
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
        """(E,) `DatasetReader.identity` of each episode."""
        return tuple(self.readers[d].identity(i) for d, i in self._places)

    @property
    def files(self) -> tuple[Path, ...]:
        """(E,) the file that holds each episode."""
        return tuple(self.readers[d].data_path(i) for d, i in self._places)

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the episodes (see `episodes_fingerprint`)."""
        return episodes_fingerprint(self.identities, self.length)

    @property
    def robot(self) -> RobotSpec:
        """The robot of all episodes."""
        return self.readers[0].robot

    @property
    def is_remote(self) -> bool:
        """Whether some data files are downloaded from the Hub when they are read."""
        return any(reader.is_remote for reader in self.readers)

    def download(self) -> None:
        """Download the files of all its episodes that are not on disk."""
        one_per_file = dict(zip(self.files, range(len(self)), strict=True)).values()
        for episode in tqdm(one_per_file, unit="file", desc="fetch", leave=False):
            reader, number = self._place(episode)
            reader.download(number)

    def prefetch(self, episodes: Sequence[int]) -> None:
        """Start to download the files of these episodes that are not on disk, in the background.

        Errors are raised when an episode is read.
        """
        for reader in self.readers:
            if reader.is_remote:
                places = map(self._place, episodes)
                reader.prefetch([number for other, number in places if other is reader])

    def read(self, episode: int) -> Episode:
        """Read one episode and validate it (see `DatasetReader.read`)."""
        reader, number = self._place(episode)
        return reader.read(number)

    def read_unchecked(self, episode: int) -> Episode:
        """Read one episode that was validated before."""
        reader, number = self._place(episode)
        columns = reader.read_episode_columns(number, tuple(EPISODE_FEATURES.values()))
        return reader.to_episode(number, columns)

    def state_statistics(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean m and standard deviation s (S,) of the state over all N frames.

        They follow from the length n_e, mean m_e and standard deviation s_e of each episode in
        ``meta/episodes``; no data file is read::

            m = sum_e (n_e / N) m_e,   s^2 = sum_e (n_e / N) (s_e^2 + (m_e - m)^2)

        Raises:
            DataError: the statistics are not recorded, or not complete.
        """
        stats = [reader.episode_stats(spec.STATE_KEY) for reader in self.readers]
        mean, std = (np.stack([stats[d][k][i] for d, i in self._places]) for k in (0, 1))
        weight = (self.length / self.num_frames)[:, None]
        total = (weight * mean).sum(0)
        variance = (weight * (std**2 + (mean - total) ** 2)).sum(0)
        return total, np.sqrt(variance)

    def _place(self, episode: int) -> tuple[DatasetReader, int]:
        return self.readers[int(self.dataset[episode])], int(self.number[episode])

    @property
    def _places(self) -> list[tuple[int, int]]:
        return list(zip(self.dataset.tolist(), self.number.tolist(), strict=True))


def evenly_spaced[T: np.generic](values: NDArray[T], limit: int | None) -> NDArray[T]:
    """At most ``limit`` of the values, evenly spaced in their order; None: all."""
    if limit is None or limit >= len(values):
        return values
    return values[np.linspace(0, len(values) - 1, limit).round().astype(np.intp)]


def episodes_fingerprint(identities: Sequence[str], length: NDArray[np.int64]) -> str:
    """Hash of the episodes' identities and lengths, in order."""
    text = "\n".join(f"{i} {n}" for i, n in zip(identities, length, strict=True))
    return hashlib.sha256(text.encode()).hexdigest()


def require_mixable(readers: Sequence[DatasetReader]) -> None:
    """Raise `DataError` unless all datasets share robot, controller and rate."""
    if not readers:
        raise DataError("no dataset given")
    first = readers[0]
    for other in readers[1:]:
        if other.robot != first.robot:
            raise DataError(
                f"{other.root} is of robot {other.robot.robot_type}, {first.root} of robot "
                f"{first.robot.robot_type}, or their names and sizes differ; train on the data of "
                "one robot"
            )
        for what in ("controller_id", "fps"):
            have, want = getattr(other, what), getattr(first, what)
            if have != want:
                raise DataError(
                    f"{other.root} has {what} {have}, {first.root} has {want}; datasets must have "
                    f"the same {what} to be trained on together"
                )


def describe_heldout(readers: Sequence[DatasetReader]) -> dict[str, Any]:
    """JSON-compatible description of the held-out episodes; raises `DataError` if none is.

    ``numbers`` lists them for each dataset, or is null if they are more than `MAX_LISTED`.
    """
    heldout = EpisodeIndex.of(readers, "heldout")
    numbers = [heldout.number[heldout.dataset == d].tolist() for d in range(len(readers))]
    return {
        "rule": RULE,
        "fraction": HELDOUT_FRACTION,
        "count": len(heldout),
        "fingerprint": heldout.fingerprint,
        "numbers": numbers if len(heldout) <= MAX_LISTED else None,
    }


def sample_files(
    train: EpisodeIndex, heldout: EpisodeIndex, files: int
) -> tuple[EpisodeIndex, EpisodeIndex]:
    """Training and held-out episodes in a few files, the same files for both if possible.

    All episodes of a dataset on disk are kept; of one on the Hub those in at most ``files``
    files of each task, evenly spaced.
    """
    return _sample_files(train, heldout, files), _sample_files(heldout, train, files)


def _sample_files(index: EpisodeIndex, other: EpisodeIndex, files: int) -> EpisodeIndex:
    shared = set(_file_keys(other))
    own = _file_keys(index)
    kept = np.zeros(len(index), dtype=np.bool_)
    for task, dataset in sorted({(task, dataset) for task, dataset, _ in own}):
        names = sorted({f for t, d, f in own if (t, d) == (task, dataset)})
        if index.readers[dataset].is_remote:
            common = [f for f in names if (task, dataset, f) in shared]
            names = evenly_spaced(np.array(common or names), files).tolist()
        wanted = {(task, dataset, f) for f in names}
        kept |= np.array([key in wanted for key in own])
    return index.select(np.flatnonzero(kept))


def _file_keys(index: EpisodeIndex) -> list[tuple[str, int, str]]:
    """Task, dataset and file of each episode."""
    files = (path.as_posix() for path in index.files)
    return list(zip(index.tasks, index.dataset.tolist(), files, strict=True))
