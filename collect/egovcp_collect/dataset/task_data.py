"""Data of each task for statistics: all columns but depth, and a sample of whole episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import (
    DatasetReader,
    Episode,
    ReturnConfig,
    is_terminal,
    mc_return,
    mc_valid,
    schema,
)
from egovcp.data.features import nonfinite_problem, parse_feature
from egovcp.data.parquet import Columns
from egovcp.errors import DataError
from egovcp.robot.kinematics import palm_positions
from egovcp.sim.tasks import Task
from egovcp.sim.tasks.registry import installed_task

_COLUMNS: Final = (
    spec.ACTION_KEY,
    spec.REWARD_KEY,
    spec.DONE_KEY,
    spec.SUCCESS_KEY,
    spec.TRUNCATED_KEY,
    spec.REWARD_TERMS_KEY,
)
_SAMPLED_EPISODES: Final = 12  # of each task
_SHOWN_EPISODES: Final = 2  # of each task
SHOWN_FRAMES: Final = 8
"""Depth images shown of an episode."""
_NEAR_MM: Final = 1000


@dataclass(frozen=True)
class TaskRows:
    """N rows of the E episodes of one task, in order."""

    task: str
    episodes: NDArray[np.int64]  # (E,) index in the dataset
    length: NDArray[np.int64]  # (E,) rows
    metadata: Sequence[Mapping[str, Any]]  # (E,)
    action: NDArray[np.float32]  # (N, 7), in [-1, 1]
    reward: NDArray[np.float32]  # (N,)
    reward_terms: NDArray[np.float32]  # (N, 6) `spec.REWARD_TERMS`; zeros if not recorded
    fallen: NDArray[np.bool_]  # (E,) the episode ended in a fall
    success: NDArray[np.bool_]  # (E,) in the last row
    mc_return: NDArray[np.float32]  # (N,) Monte Carlo return
    mc_valid: NDArray[np.bool_]  # (N,) the time limit does not cut the return short

    @property
    def start(self) -> NDArray[np.int64]:
        """(E,) first row of each episode."""
        return self.length.cumsum() - self.length


def read_rows(reader: DatasetReader, returns: ReturnConfig) -> list[TaskRows]:
    """The rows of each task in the dataset, in the order of their first episodes.

    Raises:
        DataError: a file is damaged, or a value is not finite.
    """
    columns = reader.read_columns(_COLUMNS)
    _require_finite(reader, columns)
    tasks = np.array([reader.task(i) for i in range(len(reader))])
    found = []
    for task in dict.fromkeys(tasks.tolist()):
        episodes = np.flatnonzero(tasks == task)
        length = reader.lengths[episodes]
        last = length.cumsum() - 1
        rows = np.repeat(tasks == task, reader.lengths)
        action, reward, done, success, truncated, terms = (columns[k][rows] for k in _COLUMNS)
        rewards = np.split(reward, last[:-1] + 1)
        valid = [
            mc_valid(n, reader.time_limit(i), returns.steps, returns.keep_truncated)
            for i, n in zip(episodes.tolist(), length.tolist(), strict=True)
        ]
        found.append(
            TaskRows(
                task=task,
                episodes=episodes,
                length=length,
                metadata=[reader.metadata(i) for i in episodes.tolist()],
                action=action,
                reward=reward,
                reward_terms=terms,
                fallen=is_terminal(done, truncated)[last],
                success=success[last],
                mc_return=np.concatenate(
                    [mc_return(r, returns.gamma, returns.steps) for r in rewards]
                ),
                mc_valid=np.concatenate(valid),
            )
        )
    return found


def _require_finite(reader: DatasetReader, columns: Columns) -> None:
    """Raise `DataError` for the first value of ``columns``, (N, ...), that is not finite."""
    for key, values in columns.items():
        feature = parse_feature(key, schema.feature_of(key, reader.robot))
        found = nonfinite_problem(values.reshape(len(values), -1), feature)
        if found is not None:
            row, problem = found
            ends = reader.lengths.cumsum()
            episode = int(np.searchsorted(ends, row, side="right"))
            frame = row - int(ends[episode] - reader.lengths[episode])
            raise DataError.at(reader.data_path(episode), problem, episode, frame)


@dataclass(frozen=True)
class DepthFrames:
    """F depth images of one episode, from its event on."""

    episode: int  # index in the dataset
    tick: NDArray[np.int64]  # (F,)
    depth: NDArray[np.uint16]  # (F, 48, 64) mm


@dataclass(frozen=True)
class DepthStatistics:
    """Statistics of the depth images of the sampled episodes; shares are in [0, 1]."""

    episodes: int
    frames: int
    valid_share: float  # measured pixels
    near_share: float  # pixels nearer than 1 m
    empty_share: float  # frames without a measured pixel
    median_m: float  # of the measured pixels


@dataclass(frozen=True)
class TaskSample:
    """What is computed from the sampled episodes of one task."""

    depth: DepthStatistics
    palms_b: NDArray[np.float32]  # (M, 2, 3) left and right, m, pelvis heading frame
    shown: tuple[DepthFrames, ...]


def sample_episodes(reader: DatasetReader, rows: TaskRows) -> TaskSample:
    """Read up to 12 episodes, spread evenly over those of the task, one at a time.

    Raises:
        DataError: an episode is damaged.
    """
    total = len(rows.episodes)
    places = np.linspace(0, total - 1, min(_SAMPLED_EPISODES, total))
    indices = rows.episodes[np.unique(np.rint(places).astype(int))].tolist()
    with_event = [i for i in indices if reader.metadata(i).get("event_tick") is not None]
    shown_indices = (with_event or indices)[:_SHOWN_EPISODES]
    pixels = np.zeros(1 << 16, np.int64)  # histogram over mm; 0 is not measured
    frames = empty = 0
    palms, shown = [], []
    for index in indices:
        episode = reader.read(index)
        pixels += np.bincount(episode.depth.reshape(-1), minlength=1 << 16)
        frames += len(episode)
        empty += int((episode.depth.max(axis=(1, 2)) == 0).sum())
        palms.append(palm_positions(episode.state).astype(np.float32))
        if index in shown_indices:
            shown.append(_event_frames(episode, index))
    valid = int(pixels[1:].sum())
    median = int(np.searchsorted(pixels[1:].cumsum(), valid / 2)) + 1 if valid else 0
    depth = DepthStatistics(
        episodes=len(indices),
        frames=frames,
        valid_share=valid / int(pixels.sum()),
        near_share=int(pixels[1:_NEAR_MM].sum()) / int(pixels.sum()),
        empty_share=empty / frames,
        median_m=median / 1000.0,
    )
    return TaskSample(depth, np.concatenate(palms), tuple(shown))


def _event_frames(episode: Episode, index: int) -> DepthFrames:
    """Up to `SHOWN_FRAMES` images from the event on; from the start if there is none."""
    first = min(episode.metadata.get("event_tick") or 0, len(episode) - 1)
    task = installed_task(episode.task) or Task
    last = min(first + task.event_duration_ticks, len(episode) - 1)
    tick = np.unique(np.rint(np.linspace(first, last, SHOWN_FRAMES)).astype(np.int64))
    return DepthFrames(index, tick, episode.depth[tick])
