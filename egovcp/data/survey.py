"""Statistics of a whole dataset, from one pass that holds one episode at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp import spec
from egovcp.data import targets
from egovcp.data.index import EpisodeIndex
from egovcp.data.returns import ReturnConfig


@dataclass(frozen=True)
class Survey:
    """Facts about all rows. Only returns are kept: 4 bytes of a row's 6.3 kB."""

    state_mean: NDArray[np.float64]
    """(74,)."""
    state_std: NDArray[np.float64]
    """(74,)."""
    returns: NDArray[np.float32]
    """Monte Carlo returns of the rows that have a complete one."""
    complete: NDArray[np.int64]
    """(D,) how many of them each dataset has."""


def survey_sample(
    index: EpisodeIndex,
    sample: EpisodeIndex,
    returns: ReturnConfig | None = None,
) -> Survey:
    """What `survey` says of ``index``, while only ``sample``, a part of it, is read.

    Mean and deviation of the state are those of all its episodes, from the statistics that
    `meta/episodes` keeps of each. Returns are those of the sample.

    Raises:
        DataError: a dataset is damaged, or lacks these statistics.
        EnvironmentFailure: the Hub, from which it comes, cannot be reached.
    """
    found = survey(sample, returns)
    stats = [reader.episode_stats(spec.STATE_KEY) for reader in index.readers]
    places = list(zip(index.dataset.tolist(), index.number.tolist(), strict=True))
    mean, std = (np.stack([stats[d][k][i] for d, i in places]) for k in (0, 1))
    weight = (index.length / index.num_frames)[:, None]
    total = (weight * mean).sum(0)
    variance = (weight * (std**2 + (mean - total) ** 2)).sum(0)
    return replace(found, state_mean=total, state_std=np.sqrt(variance))


def survey(index: EpisodeIndex, returns: ReturnConfig | None = None) -> Survey:
    """Read every episode once, validated.

    Raises:
        DataError: a dataset is damaged, or holds what is no number.
    """
    config = returns or ReturnConfig()
    total, squares = np.zeros(spec.STATE_DIM), np.zeros(spec.STATE_DIM)
    found: list[NDArray[np.float32]] = []
    for number in tqdm(range(len(index)), unit="ep", desc="check", leave=False):
        episode = index.read(number)
        state = episode.state.astype(np.float64)
        total += state.sum(0)
        squares += np.square(state).sum(0)
        valid = targets.mc_valid(
            len(episode), episode.time_limit, config.steps, config.keep_truncated
        )
        found.append(targets.mc_return(episode.reward, config.gamma, config.steps)[valid])
    mean = total / index.num_frames
    variance = np.maximum(squares / index.num_frames - np.square(mean), 0.0)
    complete = np.bincount(index.dataset, weights=[len(returns) for returns in found])
    return Survey(mean, np.sqrt(variance), np.concatenate(found), complete.astype(np.int64))
