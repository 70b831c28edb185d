"""The columns of a dataset that its coverage is judged by, task by task; no depth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import DatasetReader, ReturnConfig, is_terminal, mc_return, mc_valid

_COLUMNS = (
    spec.ACTION_KEY,
    spec.REWARD_KEY,
    spec.DONE_KEY,
    spec.SUCCESS_KEY,
    spec.TRUNCATED_KEY,
)


@dataclass(frozen=True)
class TaskRows:
    """N rows of E episodes of one task, one episode after the other."""

    task: str
    episodes: NDArray[np.int64]
    """(E,) index of each episode in the dataset."""
    length: NDArray[np.int64]
    """(E,) rows of each episode."""
    metadata: Sequence[Mapping[str, Any]]
    """(E,) facts of each episode."""
    action: NDArray[np.float32]
    """(N, 7) box units."""
    reward: NDArray[np.float32]
    """(N,)."""
    fallen: NDArray[np.bool_]
    """(E,) the episode ended in a failure."""
    success: NDArray[np.bool_]
    """(E,) the task's success at the last row."""
    mc_return: NDArray[np.float32]
    """(N,) Monte Carlo return of each row."""
    mc_valid: NDArray[np.bool_]
    """(N,) the return is not cut short by the time limit."""

    @property
    def start(self) -> NDArray[np.int64]:
        """(E,) first row of each episode."""
        return self.length.cumsum() - self.length

    def spans(self) -> Iterator[slice]:
        """The rows of each episode, in order."""
        for first, count in zip(self.start.tolist(), self.length.tolist(), strict=True):
            yield slice(first, first + count)


def read_rows(reader: DatasetReader, returns: ReturnConfig) -> list[TaskRows]:
    """The rows of each task that the dataset has, in the order of `spec.TASKS`.

    About 50 bytes per row: half a million rows take 25 MB.

    Raises:
        DataError: a file is damaged.
    """
    columns = reader.read_columns(_COLUMNS)
    tasks = np.array([reader.task(i) for i in range(len(reader))])
    present = [task for task in spec.TASKS if (tasks == task).any()]
    return [_rows_of(reader, task, tasks == task, columns, returns) for task in present]


def _rows_of(
    reader: DatasetReader,
    task: str,
    chosen: NDArray[np.bool_],
    columns: Mapping[str, NDArray[Any]],
    returns: ReturnConfig,
) -> TaskRows:
    episodes = np.flatnonzero(chosen)
    length = reader.lengths[episodes]
    mine = np.repeat(chosen, reader.lengths)
    last = length.cumsum() - 1
    reward = columns[spec.REWARD_KEY][mine]
    done, truncated = columns[spec.DONE_KEY][mine], columns[spec.TRUNCATED_KEY][mine]
    parts = np.split(reward, last[:-1] + 1)
    limits = [reader.time_limit(int(i)) for i in episodes]
    valid = [
        mc_valid(len(part), limit, returns.steps, returns.keep_truncated)
        for part, limit in zip(parts, limits, strict=True)
    ]
    return TaskRows(
        task=task,
        episodes=episodes,
        length=length,
        metadata=[reader.metadata(int(i)) for i in episodes],
        action=columns[spec.ACTION_KEY][mine],
        reward=reward,
        fallen=is_terminal(done, truncated)[last],
        success=columns[spec.SUCCESS_KEY][mine][last],
        mc_return=np.concatenate([mc_return(p, returns.gamma, returns.steps) for p in parts]),
        mc_valid=np.concatenate(valid),
    )
