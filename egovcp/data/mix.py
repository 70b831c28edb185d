"""How often each dataset and each task is drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.errors import UsageError, suggest


@dataclass(frozen=True)
class Mix:
    """Weights of datasets and tasks; without any, every row is as likely as every other."""

    datasets: tuple[float, ...] = ()
    """Weight of each dataset, whatever its size; empty: in proportion to its frames."""
    tasks: Mapping[str, float] = field(default_factory=dict)
    """Task -> how much more often than by chance it is drawn; 1 where it is not named."""

    @property
    def is_plain(self) -> bool:
        """No weights at all."""
        return not self.datasets and not self.tasks

    def check(self) -> None:
        """Raise `UsageError` for weights that make no sense."""
        for task in self.tasks:
            if task not in spec.TASKS:
                raise UsageError(f"a weight for unknown task {task!r}{suggest(task, spec.TASKS)}")
        weights = [*self.datasets, *self.tasks.values()]
        wrong = [weight for weight in weights if not (weight >= 0 and math.isfinite(weight))]
        if wrong:
            raise UsageError(f"a weight of {wrong[0]}: expected a finite number of at least 0")

    def as_dict(self) -> dict[str, Any]:
        """JSON-compatible."""
        return {"datasets": list(self.datasets), "tasks": dict(sorted(self.tasks.items()))}


class Groups(NamedTuple):
    """The episodes of one task in one dataset form a group."""

    of: NDArray[np.int64]  # (E,) group of each episode
    share: NDArray[np.float64]  # (G,) of the windows; they add up to 1


def group(
    mix: Mix, dataset: NDArray[np.int64], tasks: Sequence[str], length: NDArray[np.int64]
) -> Groups:
    """Part episodes into groups and weigh them.

    Args:
        mix: the weights.
        dataset: (E,) which dataset each episode is of.
        tasks: (E,) task of each episode.
        length: (E,) frames of each episode.

    Raises:
        UsageError: the weights make no sense, or leave nothing to draw.
    """
    mix.check()
    if mix.datasets and len(mix.datasets) <= dataset.max():
        raise UsageError(f"{len(mix.datasets)} weights for {dataset.max() + 1} datasets")
    if mix.is_plain:
        return Groups(np.zeros(len(dataset), dtype=np.int64), np.ones(1))
    keys = sorted(set(zip(dataset.tolist(), tasks, strict=True)))
    number = {key: i for i, key in enumerate(keys)}
    of = np.array([number[key] for key in zip(dataset.tolist(), tasks, strict=True)])
    share = np.bincount(of, weights=length).astype(np.float64)
    if mix.datasets:
        frames = np.bincount(dataset, weights=length)
        share *= np.array([mix.datasets[d] / frames[d] for d, _ in keys])
    share *= np.array([mix.tasks.get(task, 1.0) for _, task in keys])
    if not share.sum() > 0:
        raise UsageError("the weights of datasets and tasks leave no episode to draw")
    return Groups(of, share / share.sum())


class Pools:
    """Rows by group, to pick from."""

    def __init__(self, rows: NDArray[np.int64], group_of_rows: NDArray[np.int64], groups: int):
        order = np.argsort(group_of_rows, kind="stable")
        self._rows = rows[order]
        self._count = np.bincount(group_of_rows, minlength=groups)
        self._first = self._count.cumsum() - self._count

    def pick(self, rng: np.random.Generator, group: NDArray[np.int64]) -> NDArray[np.int64]:
        """A row of each of these groups, drawn uniformly. None may be empty."""
        place = (rng.random(len(group)) * self._count[group]).astype(np.int64)
        at = np.minimum(self._first[group] + place, len(self._rows) - 1)
        return np.asarray(self._rows[at])
