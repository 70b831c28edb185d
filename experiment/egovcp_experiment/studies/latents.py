"""Where the tasks lie in h and z, and whether time shows there (figure 6b, c).

States are those of closed-loop play of every task with one model. Beside the t-SNE pictures two
numbers of the states themselves, from the nearest states of *other* episodes: how often they are
of the same task, and how much of the variance of the tick they explain.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.sim.scenario import Scenario
from egovcp.spec import TASKS
from egovcp_experiment.studies.study import finish
from egovcp_experiment.studies.watching import Moment, WatchConfig, Watcher, watch
from egovcp_experiment.tsne import tsne

PROG: Final = "python -m egovcp_experiment.studies.latents"
_NEIGHBOURS: Final = 10


@dataclass(frozen=True)
class LatentsConfig(WatchConfig):
    """Maps of h and z over several tasks."""

    task: str = "all"
    """Tasks are those of --tasks."""
    tasks: tuple[str, ...] = TASKS
    """Tasks to play."""
    points: int = 1200
    """States in a map, evenly spread over all that were met."""
    perplexity: float = 30.0
    """Of t-SNE."""


class _States(NamedTuple):
    """States of all tasks."""

    h: Tensor
    z: Tensor
    task: Tensor
    episode: Tensor
    tick: Tensor


class _Seen(Watcher):
    """Keeps h and z of every tick."""

    def __init__(self, task: int) -> None:
        self._task = task
        self.rows: list[tuple[Tensor, Tensor, int, int, int]] = []

    def begin(self, scenarios: Sequence[Scenario]) -> None:
        self._episodes = [scenario.episode for scenario in scenarios]

    def before(self, moment: Moment) -> None:
        carry = moment.policy.carry.map(lambda x: x.cpu().clone())
        for row in np.flatnonzero(moment.live).tolist():
            facts = (self._task, self._episodes[row], int(moment.env.tick[row]))
            self.rows.append((carry.h[row], carry.z[row], *facts))


def measure(config: LatentsConfig) -> None:
    """Play, and write the maps."""
    if config.points < 4 or not config.tasks:
        raise UsageError("--points must be at least 4, and --tasks name a task")
    artifact = config.artifact()
    rows = []
    for number, task in enumerate(config.tasks):
        seen = _Seen(number)
        watch(artifact, config.env, replace(config, task=task), seen)
        rows += seen.rows
    states = _spread(rows, config.points)
    figures: dict[str, Any] = {
        "tasks": list(config.tasks),
        "task": states.task.tolist(),
        "tick": states.tick.tolist(),
    }
    for name, points in (("h", states.h), ("z", states.z)):
        figures[name] = neighbours(points, states.task, states.episode, states.tick) | {
            "map": [[round(v, 3) for v in row] for row in tsne(points, config.perplexity).tolist()]
        }
    finish(config, figures)


def _spread(rows: Sequence[tuple[Tensor, Tensor, int, int, int]], count: int) -> _States:
    """At most ``count`` of the rows, evenly."""
    chosen = np.unique(np.linspace(0, len(rows) - 1, count).astype(int)).tolist()
    h, z, task, episode, tick = zip(*(rows[i] for i in chosen), strict=True)
    numbers = (torch.tensor(part) for part in (task, episode, tick))
    return _States(torch.stack(h), torch.stack(z), *numbers)


def neighbours(points: Tensor, task: Tensor, episode: Tensor, tick: Tensor) -> dict[str, Any]:
    """What the nearest states of other episodes say of a state.

    Args:
        points: (n, d).
        task: (n,) number of the task.
        episode: (n,) number of the episode within its task.
        tick: (n,) planner tick.

    Returns:
        ``same_task``, the share of neighbours of the same task, ``chance`` of it, and ``tick_r2``,
        the share of the tick's variance within a task that its neighbours' mean explains.
    """
    distance = torch.cdist(points.double(), points.double())
    own = (task[:, None] == task) & (episode[:, None] == episode)
    distance.masked_fill_(own, torch.inf)
    count = min(_NEIGHBOURS, len(points) - 1)
    near = distance.topk(count, largest=False)
    there = near.values.isfinite()
    same = (task[near.indices] == task[:, None]) & there
    shares = torch.bincount(task).double() / len(task)
    return {
        "same_task": float(same.sum() / there.sum().clamp_min(1)),
        "chance": float(shares.square().sum()),
        "tick_r2": _tick_r2(tick.double(), task, same, near.indices),
    }


def _tick_r2(tick: Tensor, task: Tensor, same: Tensor, index: Tensor) -> float | None:
    guess = (tick[index] * same).sum(1) / same.sum(1).clamp_min(1)
    known = same.any(1)
    error = total = 0.0
    for number in range(int(task.max()) + 1):
        rows = known & (task == number)
        if int(rows.sum()) > 1:
            error += float((guess[rows] - tick[rows]).square().sum())
            total += float((tick[rows] - tick[rows].mean()).square().sum())
    return 1 - error / total if total > 0 else None


CONFIG = LatentsConfig


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run_command(CONFIG, measure, argv, prog=PROG)


if __name__ == "__main__":
    sys.exit(main())
