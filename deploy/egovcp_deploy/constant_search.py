"""The best constant action of a task: what a fixed guard or a permanent crouch would earn.

Every candidate of a coarse grid of left-right symmetric poses plays the same few scenarios;
the best quarter play more of them, and so on until one is left (successive halving).
The scenarios are `scenarios.for_search`, so the choice never sees the evaluation's.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from egovcp.errors import DataError
from egovcp.files import UnsafeFileError, read_json
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_DIM
from egovcp_deploy.scenarios import for_search
from egovcp_deploy.scores import EpisodeScore, reward_per_step

type Action = tuple[float, ...]
#: Plays one scenario per action, the action held throughout.
type PlayConstants = Callable[[Sequence[Action], Sequence[Scenario]], list[EpisodeScore]]

#: Box units per task: forward, outward (left hand's y; the right hand mirrors it), up, height.
_GRIDS: Final[dict[str, tuple[tuple[float, ...], ...]]] = {
    "ball": ((0.2, 0.45, 0.8), (0.0, -0.3, -0.6), (0.35, 0.6, 0.85), (0.0,)),
    "wall": ((0.4, 0.8, 1.0), (0.0, -0.3), (0.3, 0.55, 0.8), (0.0,)),
    "arch": ((0.0,), (0.0,), (0.0,), (0.0, -0.2, -0.4, -0.6, -0.8, -1.0)),
    "sequence": ((0.2, 0.45), (0.0, -0.3), (0.35, 0.6), (0.0, -0.6, -1.0)),
}
_KEEP: Final = 4  # a quarter goes on to the next round
_FIRST_ROUND: Final = 6  # scenarios that every candidate plays


@dataclass(frozen=True)
class BestConstant:
    """The winner of the search."""

    action: Action
    reward_mean: float
    """Per step, on the search's own scenarios."""
    success_rate: float
    episodes: int
    """Scenarios it played."""


def grid(task: str) -> list[Action]:
    """The candidates; the neutral pose is always one of them."""
    neutral = (0.0,) * ACTION_DIM
    poses = [_symmetric(*values) for values in itertools.product(*_GRIDS[task])]
    return [neutral, *[pose for pose in poses if pose != neutral]]


def _symmetric(forward: float, outward: float, up: float, height: float) -> Action:
    return (forward, outward, up, forward, 0.0 - outward, up, height)


def search_constant(task: str, seed: int, play: PlayConstants) -> BestConstant:
    """The action of the grid with the highest mean reward per step.

    Args:
        task: which grid and which scenarios.
        seed: the user's seed.
        play: plays one scenario per given action and returns the scores in order.
    """
    scores: dict[Action, list[EpisodeScore]] = {action: [] for action in grid(task)}
    left, count = list(scores), _FIRST_ROUND
    while len(left) > 1:
        first = len(scores[left[0]])
        scenarios = [for_search(task, seed, first + i) for i in range(count)]
        pairs = list(itertools.product(left, scenarios))
        played = play([action for action, _ in pairs], [scenario for _, scenario in pairs])
        for (action, _), score in zip(pairs, played, strict=True):
            scores[action].append(score)
        left.sort(key=lambda action: -reward_per_step(scores[action]))
        left, count = left[: max(1, len(left) // _KEEP)], count * 2
    return _best(left[0], scores[left[0]])


def _best(action: Action, scores: Sequence[EpisodeScore]) -> BestConstant:
    rate = float(np.mean([score.success for score in scores]))
    return BestConstant(action, reward_per_step(scores), rate, len(scores))


def load_constants(path: Path) -> dict[str, BestConstant]:
    """Task -> winner, from the ``constant.json`` of an earlier evaluation.

    Raises:
        DataError: no such file, or not one of ours.
    """
    try:
        content = read_json(path)
        return {task: _parse(entry) for task, entry in content.items()}
    except OSError as error:
        raise DataError(f"cannot read --constant.path={path}: {error.strerror}") from error
    except UnsafeFileError as error:
        raise DataError(f"cannot read --constant.path={path}: {error}") from error
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise DataError(
            f"--constant.path={path} is not the constant.json of an evaluation: {error!r}"
        ) from error


def _parse(entry: dict[str, Any]) -> BestConstant:
    action = tuple(float(value) for value in entry["action"])
    if len(action) != ACTION_DIM or not np.all(np.abs(action) <= 1.0):
        raise ValueError(f"expected {ACTION_DIM} numbers from -1 to 1, found {action}")
    return BestConstant(**entry | {"action": action})
