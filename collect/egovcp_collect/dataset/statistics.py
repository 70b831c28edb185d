"""Statistics of a dataset per task: events, returns, actions, drawn parameters, depth.

A *success event* is a frame with a positive value, a *failure event* one with a negative value in a
column of `spec.REWARD_TERMS` other than `spec.ACTION_TERMS`. In episodes of earlier versions, which
lack these columns, it is a frame whose reward differs from the task's median reward by more than
`spec.EVENT_REWARD`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from egovcp.data import DatasetReader, ReturnConfig
from egovcp.data.provenance import SOURCE
from egovcp.errors import UsageError
from egovcp.sim.tasks.registry import installed_task
from egovcp.spec import ACTION_BOX, ACTION_NAMES, ACTION_TERMS, EVENT_REWARD, REWARD_TERMS
from egovcp_collect.dataset.task_data import (
    DepthStatistics,
    TaskRows,
    TaskSample,
    read_rows,
    sample_episodes,
)

_EVENT_COLUMNS: Final = [i for i, name in enumerate(REWARD_TERMS) if name not in ACTION_TERMS]
_SUCCESS_COLUMNS: Final = {"block", "pass"}  # columns of positive terms; see `BaseTask.terms`
HISTOGRAM_BINS: Final = 40
"""Bins of an action's histogram, over [-1, 1]."""
GRID_CELLS: Final = 8
"""Cells per axis of the grid over the x, y and z of one hand."""
#: Metadata of an episode that is not drawn.
_NOT_DRAWN: Final = {"seed", "episode", SOURCE, "reward_terms", "contact_ticks"}
_HANDS: Final = {"left": slice(0, 3), "right": slice(3, 6)}


@dataclass(frozen=True)
class Distribution:
    """Extremes, quantiles, mean and standard deviation of a set of numbers."""

    low: float
    q05: float
    median: float
    q95: float
    high: float
    mean: float
    std: float

    @classmethod
    def of(cls, values: NDArray[Any]) -> Self | None:
        """The distribution of values of any shape; None if there are none."""
        flat = np.asarray(values, np.float64).reshape(-1)
        if not flat.size:
            return None
        low, q05, median, q95, high = np.quantile(flat, (0.0, 0.05, 0.5, 0.95, 1.0)).tolist()
        return cls(low, q05, median, q95, high, float(flat.mean()), float(flat.std()))


@dataclass(frozen=True)
class TermRate:
    """How often a reward term was not 0, or a contact occurred."""

    ticks: int
    per_1000_ticks: float
    episodes: int
    episode_share: float  # of all episodes of the task
    sum: float  # of the reward term over all episodes; 0 for contacts


@dataclass(frozen=True)
class ReturnStatistics:
    """Monte Carlo returns of the frames that have one."""

    gamma: float
    horizon: int  # planner ticks
    valid_share: float  # frames whose return the time limit does not cut short
    distribution: Distribution | None  # of the valid returns; None if there are none
    success_event_share: float  # valid frames with a success event within the horizon
    failure_event_share: float  # valid frames with a failure event within the horizon


@dataclass(frozen=True)
class ActionStatistics:
    """Coverage of the action box by N actions, and uniformity of each action."""

    histogram: dict[str, list[int]]
    """Action name -> frames per bin."""
    uniformity: dict[str, float]
    """Action name -> overlap of its histogram p over n bins with the uniform one, sum of
    min(p_i, 1 / n): 1 is uniform, 1 / n is a single bin."""
    occupied: dict[str, float]
    """Hand -> share of occupied cells of the action box: grid cells that contain an action."""
    workspace_m: dict[str, tuple[float, float]]
    """Action name -> lowest and highest target, m, pelvis heading frame (height: above
    ground)."""

    @classmethod
    def of(cls, action: NDArray[np.floating]) -> Self:
        """The statistics of actions (N, 7), in [-1, 1]."""
        counts = {
            name: np.histogram(action[:, i], HISTOGRAM_BINS, (-1.0, 1.0))[0]
            for i, name in enumerate(ACTION_NAMES)
        }
        grid = [(-1.0, 1.0)] * 3
        cells = {
            hand: np.histogramdd(action[:, axes], GRID_CELLS, grid)[0]
            for hand, axes in _HANDS.items()
        }
        metric = ACTION_BOX.to_metric(action)
        ranges = zip(metric.min(axis=0).tolist(), metric.max(axis=0).tolist(), strict=True)
        return cls(
            histogram={name: count.tolist() for name, count in counts.items()},
            uniformity={
                name: float(np.minimum(count / count.sum(), 1.0 / len(count)).sum())
                for name, count in counts.items()
            },
            occupied={hand: float((count > 0).mean()) for hand, count in cells.items()},
            workspace_m=dict(zip(ACTION_NAMES, ranges, strict=True)),
        )


@dataclass(frozen=True)
class TaskStatistics:
    """Statistics of the episodes of one task. Shares are of its episodes if not said otherwise."""

    task: str
    episodes: int
    frames: int
    frame_share: float  # of the dataset's frames
    length: Distribution | None  # frames per episode
    success_share: float
    fall_share: float
    event_episodes: int  # with a success or failure event
    success_event_episodes: int
    failure_event_episodes: int
    has_success_events: bool
    """Whether the data has a success event, or the installed task rewards one; False if the reward
    has costs only."""
    term_rates: dict[str, TermRate]
    """Rate of each reward term, and of ``touch.hands`` and ``touch.other``, ticks of contact with
    the task's object, where they were recorded."""
    reward: Distribution | None
    returns: ReturnStatistics
    action: ActionStatistics
    scene: dict[str, Distribution]
    """Drawn parameter -> distribution over the episodes."""
    depth: DepthStatistics  # of the sampled episodes


@dataclass(frozen=True)
class DatasetStatistics:
    """Statistics of a dataset, and the data that its plots show; all by task."""

    tasks: tuple[TaskStatistics, ...]
    rows: tuple[TaskRows, ...]
    samples: tuple[TaskSample, ...]


def compute_statistics(reader: DatasetReader, returns: ReturnConfig) -> DatasetStatistics:
    """Statistics of each task of a dataset, from all columns but depth and from sampled episodes.

    Raises:
        DataError: a file is damaged.
        UsageError: the dataset is of another robot than the G1.
    """
    if not reader.robot.is_g1:
        raise UsageError(
            f"{reader.root} is of robot {reader.robot.robot_type}: statistics are available for "
            "the G1 only; use `egovcp-dataset info` and `check`"
        )
    rows = read_rows(reader, returns)
    samples = [sample_episodes(reader, task) for task in rows]
    frames = reader.num_frames
    tasks = [_task_statistics(r, s, returns, frames) for r, s in zip(rows, samples, strict=True)]
    return DatasetStatistics(tuple(tasks), tuple(rows), tuple(samples))


def _task_statistics(
    rows: TaskRows, sample: TaskSample, returns: ReturnConfig, frames: int
) -> TaskStatistics:
    success, failure = (np.logical_or.reduceat(event, rows.start) for event in _events(rows))
    return TaskStatistics(
        task=rows.task,
        episodes=len(rows.length),
        frames=len(rows.reward),
        frame_share=len(rows.reward) / frames,
        length=Distribution.of(rows.length),
        success_share=float(rows.success.mean()),
        fall_share=float(rows.fallen.mean()),
        event_episodes=int((success | failure).sum()),
        success_event_episodes=int(success.sum()),
        failure_event_episodes=int(failure.sum()),
        has_success_events=bool(success.any()) or _rewards_success(rows.task),
        term_rates=_term_rates(rows),
        reward=Distribution.of(rows.reward),
        returns=_return_statistics(rows, returns),
        action=ActionStatistics.of(rows.action),
        scene=drawn_parameters(rows.metadata),
        depth=sample.depth,
    )


def _rewards_success(task: str) -> bool:
    """Whether the task is installed and has a reward term of a success."""
    known = installed_task(task)
    return known is not None and not _SUCCESS_COLUMNS.isdisjoint(known.terms.values())


def _term_rates(rows: TaskRows) -> dict[str, TermRate]:
    """Name of each reward term, and ``touch.<group>`` of each contact -> rate."""
    found: dict[str, list[tuple[int, float]]] = {}  # name -> ticks and sum in each episode
    for metadata in rows.metadata:
        for name, term in metadata.get("reward_terms", {}).items():
            found.setdefault(name, []).append((int(term["ticks"]), float(term["sum"])))
        for group, ticks in metadata.get("contact_ticks", {}).items():
            found.setdefault(f"touch.{group}", []).append((int(ticks), 0.0))
    rates = {}
    for name, parts in found.items():
        ticks, episodes = sum(t for t, _ in parts), sum(t > 0 for t, _ in parts)
        rates[name] = TermRate(
            ticks,
            1000.0 * ticks / len(rows.reward),
            episodes,
            episodes / len(rows.metadata),
            sum(s for _, s in parts),
        )
    return rates


def _return_statistics(rows: TaskRows, config: ReturnConfig) -> ReturnStatistics:
    valid = rows.mc_valid
    success, failure = events_ahead(rows, config.steps)
    return ReturnStatistics(
        gamma=config.gamma,
        horizon=config.steps,
        valid_share=float(valid.mean()),
        distribution=Distribution.of(rows.mc_return[valid]),
        success_event_share=float(success[valid].mean()) if valid.any() else 0.0,
        failure_event_share=float(failure[valid].mean()) if valid.any() else 0.0,
    )


def events_ahead(rows: TaskRows, steps: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(N,) and (N,): whether a success event, or a failure event, is among the next ``steps``
    frames of the episode, including the frame itself."""
    end = np.repeat(rows.start + rows.length, rows.length)
    here = np.arange(len(rows.reward))

    def ahead(event: NDArray[np.bool_]) -> NDArray[np.bool_]:
        before = np.concatenate([[0], event.cumsum()])
        return np.asarray(before[np.minimum(here + steps, end)] > before[here])

    success, failure = _events(rows)
    return ahead(success), ahead(failure)


def _events(rows: TaskRows) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(N,) and (N,): whether a frame has a success event, and a failure event."""
    recorded = np.logical_or.reduceat(rows.reward_terms.any(axis=1), rows.start)
    recorded = np.repeat(recorded, rows.length)
    terms = rows.reward_terms[:, _EVENT_COLUMNS]
    change = rows.reward - np.median(rows.reward)
    success = np.where(recorded, np.any(terms > 0, axis=1), change > EVENT_REWARD)
    failure = np.where(recorded, np.any(terms < 0, axis=1), change < -EVENT_REWARD)
    return success, failure


def drawn_parameters(metadata: Sequence[Mapping[str, Any]]) -> dict[str, Distribution]:
    """Dotted name of each numeric scene and randomisation parameter -> distribution over the
    episodes; lists and text are left out."""
    drawn = {}
    for name, column in pd.json_normalize([dict(episode) for episode in metadata]).items():
        numbers = [x for x in column if isinstance(x, int | float) and not math.isnan(x)]
        distribution = Distribution.of(np.array(numbers))
        if distribution is not None and not _NOT_DRAWN & {*str(name).split(".")}:
            drawn[str(name)] = distribution
    return drawn
