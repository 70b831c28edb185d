"""Statistics of a whole dataset for normalisation, with one episode in memory at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp import spec
from egovcp.data.index import EpisodeIndex
from egovcp.data.returns import ReturnConfig, mc_return, mc_valid


@dataclass(frozen=True)
class TrainingStats:
    """Statistics of all rows of D datasets."""

    state_mean: NDArray[np.float64]
    """(74,)."""
    state_std: NDArray[np.float64]
    """(74,)."""
    returns: NDArray[np.float32]
    """(N,) Monte Carlo returns of the rows for which they are valid."""
    complete: NDArray[np.int64]
    """(D,) number of these rows in each dataset."""


def compute_training_stats(
    index: EpisodeIndex, returns: ReturnConfig | None = None
) -> TrainingStats:
    """Read and validate every episode once."""
    config = returns or ReturnConfig()
    total, squares = np.zeros(index.robot.state_dim), np.zeros(index.robot.state_dim)
    found: list[NDArray[np.float32]] = []
    for number in tqdm(range(len(index)), unit="ep", desc="check", leave=False):
        episode = index.read(number)
        state = episode.state.astype(np.float64)
        total += state.sum(0)
        squares += np.square(state).sum(0)
        valid = mc_valid(len(episode), episode.time_limit, config.steps, config.keep_truncated)
        reward = config.target_reward(episode.reward, episode.reward_terms)
        found.append(mc_return(reward, config.gamma, config.steps)[valid])
    mean = total / index.num_frames
    variance = np.maximum(squares / index.num_frames - np.square(mean), 0.0)
    complete = np.bincount(index.dataset, weights=[len(returns) for returns in found])
    return TrainingStats(mean, np.sqrt(variance), np.concatenate(found), complete.astype(np.int64))


def estimate_training_stats(
    index: EpisodeIndex, sample: EpisodeIndex, returns: ReturnConfig | None = None
) -> TrainingStats:
    """As `compute_training_stats` of ``index``, but only its part ``sample`` is read.

    Mean and standard deviation of the state are exact, from the statistics of each episode in
    `meta/episodes`. Returns are those of the sample.
    """
    found = compute_training_stats(sample, returns)
    stats = [reader.episode_stats(spec.STATE_KEY) for reader in index.readers]
    places = list(zip(index.dataset.tolist(), index.number.tolist(), strict=True))
    mean, std = (np.stack([stats[d][k][i] for d, i in places]) for k in (0, 1))
    weight = (index.length / index.num_frames)[:, None]
    total = (weight * mean).sum(0)
    variance = (weight * (std**2 + (mean - total) ** 2)).sum(0)
    return replace(found, state_mean=total, state_std=np.sqrt(variance))
