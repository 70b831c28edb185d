"""A few whole episodes of each task, for what is too dear to read of all: depth and joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from egovcp.data import DatasetReader, Episode
from egovcp.robot.kinematics import palm_positions
from egovcp_collect.dataset.rows import TaskRows

EPISODES: Final = 12  # of each task
STRIPS: Final = 2  # episodes of each task that are shown
FRAMES: Final = 8  # of a film strip
NEAR_MM: Final = 1000
#: How long the event of a task is worth looking at, planner ticks.
_EVENT_TICKS: Final = {"ball": 25, "wall": 50, "arch": 175}


@dataclass(frozen=True)
class FilmStrip:
    """Some frames of one episode, around its event."""

    episode: int
    """Index in the dataset."""
    tick: NDArray[np.int64]
    """(F,) planner ticks of the frames."""
    depth: NDArray[np.uint16]
    """(F, 48, 64) mm."""


@dataclass(frozen=True)
class DepthFacts:
    """What the depth of the sampled episodes holds; shares are in [0, 1]."""

    episodes: int
    """Episodes looked at."""
    frames: int
    """Frames looked at."""
    valid_share: float
    """Pixels that were measured."""
    near_share: float
    """Pixels nearer than 1 m."""
    empty_share: float
    """Frames without a single measured pixel."""
    median_m: float
    """Median of the measured depth, m."""


@dataclass(frozen=True)
class Sample:
    """What the sampled episodes of one task give."""

    depth: DepthFacts
    palms_b: NDArray[np.float32]
    """(M, 2, 3) measured palms, left and right, m, pelvis heading frame."""
    strips: tuple[FilmStrip, ...]


def take_sample(reader: DatasetReader, rows: TaskRows) -> Sample:
    """Read ``EPISODES`` episodes, spread evenly over those of the task, one at a time.

    Raises:
        DataError: an episode is damaged.
    """
    places = np.linspace(0, len(rows.episodes) - 1, min(EPISODES, len(rows.episodes)))
    chosen = [int(i) for i in rows.episodes[np.unique(np.rint(places).astype(int))]]
    eventful = [i for i in chosen if reader.metadata(i).get("event_tick") is not None]
    shown = (eventful or chosen)[:STRIPS]
    count = _DepthCount()
    palms, strips = [], []
    for index in chosen:
        episode = reader.read(index)
        count.add(episode.depth)
        palms.append(palm_positions(episode.state).astype(np.float32))
        if index in shown:
            strips.append(film_strip(episode, index))
    return Sample(count.facts(len(chosen)), np.concatenate(palms), tuple(strips))


def film_strip(episode: Episode, index: int) -> FilmStrip:
    """Up to ``FRAMES`` frames from the event on; from the start where there is none."""
    first = min(episode.metadata.get("event_tick") or 0, len(episode) - 1)
    last = min(first + _EVENT_TICKS[episode.task], len(episode) - 1)
    tick = np.unique(np.rint(np.linspace(first, last, FRAMES)).astype(np.int64))
    return FilmStrip(index, tick, episode.depth[tick])


class _DepthCount:
    """Histogram of millimetres and count of empty frames, episode by episode."""

    def __init__(self) -> None:
        self._pixels = np.zeros(1 << 16, np.int64)
        self._empty = 0
        self._frames = 0

    def add(self, depth: NDArray[np.uint16]) -> None:
        self._pixels += np.bincount(depth.reshape(-1), minlength=1 << 16)
        self._empty += int((depth.max(axis=(1, 2)) == 0).sum())
        self._frames += len(depth)

    def facts(self, episodes: int) -> DepthFacts:
        total, valid = int(self._pixels.sum()), int(self._pixels[1:].sum())
        below = self._pixels[1:].cumsum()
        median = int(np.searchsorted(below, valid / 2)) + 1 if valid else 0
        return DepthFacts(
            episodes=episodes,
            frames=self._frames,
            valid_share=valid / total,
            near_share=int(self._pixels[1:NEAR_MM].sum()) / total,
            empty_share=self._empty / self._frames,
            median_m=median / 1000.0,
        )
