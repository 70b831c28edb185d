"""t-SNE of h and z over tasks, and how well neighbours predict task and time (figure 6b, c).

States come from closed-loop play of every task with one model. Two numbers come from the nearest
states of *other* episodes: how often these are of the same task, and how much of the variance of
the tick they explain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from egovcp.bounds import bounded
from egovcp.errors import UsageError
from egovcp_experiment.config import TASKS
from egovcp_experiment.studies import study

_NEIGHBOURS: Final = 10


@dataclass(frozen=True)
class LatentsConfig(study.ScenariosConfig):
    """Maps of h and z over several tasks."""

    tasks: tuple[str, ...] = TASKS
    """Tasks to play."""
    points: int = bounded(1200, least=4)
    """States in a map, evenly spread over all steps."""

    def check(self) -> None:
        """See `StudyConfig.check`."""
        super().check()
        if not self.tasks:
            raise UsageError("--tasks=[]: expected at least one task")


def measure(config: LatentsConfig) -> None:
    """Play, and write the maps."""
    artifact = config.load()
    rows: list[tuple[Tensor, Tensor, int, int, int]] = []
    for number, name in enumerate(config.tasks):
        play = study.SimStudyConfig(task=name, episodes=config.episodes, seed=config.seed)
        for step in study.play_episodes(artifact, config.env, play):
            carry = step.carry.map(lambda x: x.cpu())
            for row in step.live:
                facts = (number, step.scenarios[row].episode, int(step.tick[row]))
                rows.append((carry.h[row], carry.z[row], *facts))
    chosen = np.unique(np.linspace(0, len(rows) - 1, config.points).astype(int)).tolist()
    h, z, *numbers = zip(*(rows[i] for i in chosen), strict=True)
    task, episode, tick = map(torch.tensor, numbers)
    metrics: dict[str, Any] = {
        "tasks": list(config.tasks),
        "task": task.tolist(),
        "tick": tick.tolist(),
    }
    for name, points in (("h", torch.stack(h)), ("z", torch.stack(z))):
        flat = tsne_map(points).round(3).tolist()
        metrics[name] = neighbours(points, task, episode, tick) | {"map": flat}
    config.write(metrics)


def tsne_map(points: Tensor, perplexity: float = 30.0) -> NDArray[np.float64]:
    """(n, d) points -> (n, 2) by t-SNE; at most n / 3 neighbours count."""
    from sklearn.manifold import TSNE  # takes seconds

    perplexity = min(perplexity, (len(points) - 1) / 3)
    tsne = TSNE(perplexity=perplexity, init="pca", random_state=0)
    return np.asarray(tsne.fit_transform(points.numpy()), np.float64)


def neighbours(points: Tensor, task: Tensor, episode: Tensor, tick: Tensor) -> dict[str, Any]:
    """Statistics of the nearest states of other episodes.

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
    near = distance.topk(min(_NEIGHBOURS, len(points) - 1), largest=False)
    other = near.values.isfinite()
    same = (task[near.indices] == task[:, None]) & other
    shares = torch.bincount(task).double() / len(task)
    return {
        "same_task": float(same.sum() / other.sum().clamp_min(1)),
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


main = study.make_main("latents", LatentsConfig, measure)

if __name__ == "__main__":
    raise SystemExit(main())
