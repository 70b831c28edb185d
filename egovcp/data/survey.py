"""What must be known of a whole dataset, found in one pass that holds one episode at a time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp import spec
from egovcp.data import targets
from egovcp.data.index import EpisodeIndex
from egovcp.data.returns import ReturnConfig

_EVENT_SHARE: Final = 0.1  # of the farthest reward, below which a row is no event


@dataclass(frozen=True)
class EventBound:
    """Which rewards of a task are events.

    Judged by the reward column alone: no simulator truth, no knowledge of the tasks. A
    reward is exceptional if it is farther from the task's median than a quantile of all
    rows and than a tenth of the farthest: a dense cost, such as that of the pose, has its
    outliers too, but they are no events beside a contact or a fall.
    """

    median: np.floating
    """Of the task's rewards."""
    distance: np.floating
    """From the median, beyond which a row is an event."""

    @classmethod
    def of(cls, reward: NDArray[np.float32], quantile: float) -> Self:
        """The bound for all rewards (N,) of a task."""
        median = np.median(reward)
        distance = np.abs(reward - median)
        return cls(median, max(np.quantile(distance, quantile), _EVENT_SHARE * distance.max()))

    def marks(self, reward: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(T,) which rows are events."""
        return np.asarray(np.abs(reward - self.median) > self.distance)


@dataclass(frozen=True)
class Survey:
    """Facts about all rows. Only rewards and returns are kept: 8 bytes of a row's 6.3 kB."""

    state_mean: NDArray[np.float64]
    """(74,)."""
    state_std: NDArray[np.float64]
    """(74,)."""
    returns: NDArray[np.float32]
    """Monte Carlo returns of the rows that have a complete one."""
    complete: NDArray[np.int64]
    """(D,) how many of them each dataset has."""
    events: Mapping[str, EventBound]
    """Task -> which rewards are events."""


def survey_sample(
    index: EpisodeIndex,
    sample: EpisodeIndex,
    returns: ReturnConfig | None = None,
    event_quantile: float = 0.98,
) -> Survey:
    """What `survey` says of ``index``, while only ``sample``, a part of it, is read.

    Mean and deviation of the state are those of all its episodes, from the statistics that
    `meta/episodes` keeps of each. Returns and events are those of the sample.

    Raises:
        DataError: a dataset is damaged, or lacks these statistics.
        EnvironmentFailure: the Hub, from which it comes, cannot be reached.
    """
    found = survey(sample, returns, event_quantile)
    stats = [reader.episode_stats(spec.STATE_KEY) for reader in index.readers]
    places = list(zip(index.dataset.tolist(), index.number.tolist(), strict=True))
    mean, std = (np.stack([stats[d][k][i] for d, i in places]) for k in (0, 1))
    weight = (index.length / index.num_frames)[:, None]
    total = (weight * mean).sum(0)
    variance = (weight * (std**2 + (mean - total) ** 2)).sum(0)
    return replace(found, state_mean=total, state_std=np.sqrt(variance))


def survey(
    index: EpisodeIndex, returns: ReturnConfig | None = None, event_quantile: float = 0.98
) -> Survey:
    """Read every episode once, validated.

    Raises:
        DataError: a dataset is damaged, or holds what is no number.
    """
    config = returns or ReturnConfig()
    total, squares = np.zeros(spec.STATE_DIM), np.zeros(spec.STATE_DIM)
    rewards: defaultdict[str, list[NDArray[np.float32]]] = defaultdict(list)
    found: list[NDArray[np.float32]] = []
    for number in tqdm(range(len(index)), unit="ep", desc="check", leave=False):
        episode = index.read(number)
        state = episode.state.astype(np.float64)
        total += state.sum(0)
        squares += np.square(state).sum(0)
        rewards[episode.task].append(episode.reward)
        steps = config.steps_of(int(index.dataset[number]))
        valid = targets.mc_valid(len(episode), episode.time_limit, steps, config.keep_truncated)
        found.append(targets.mc_return(episode.reward, config.gamma, steps)[valid])
    mean = total / index.num_frames
    variance = np.maximum(squares / index.num_frames - np.square(mean), 0.0)
    bounds = {
        task: EventBound.of(np.concatenate(parts), event_quantile)
        for task, parts in rewards.items()
    }
    complete = np.bincount(index.dataset, weights=[len(returns) for returns in found])
    return Survey(mean, np.sqrt(variance), np.concatenate(found), complete.astype(np.int64), bounds)
