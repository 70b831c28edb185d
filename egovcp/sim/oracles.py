"""Scripted policies that see the truth: proof that a task can be solved.

They obey the same delays and rate limits as every other policy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from egovcp.sim.env import VectorEnv
from egovcp.sim.scenario import Scenario
from egovcp.sim.truth import Truth
from egovcp.spec import ACTION_BOX

Array = NDArray[np.float64]

_GRAVITY: Final = np.array([0.0, 0.0, -9.81])
_LOOKAHEAD: Final = np.arange(0.0, 1.2, 0.01)  # s


class TaskOracle(Protocol):
    """The solution of one task."""

    def act(self, truth: Truth, row: int) -> Array:
        """(7,) the action for one row."""
        ...


@dataclass(frozen=True)
class BallOracleConfig:
    """Where and how the ball oracle meets the ball."""

    reach: float = 0.32
    """Distance before the pelvis at which the hand waits in the ball's way, m."""
    hand_offset: tuple[float, float, float] = (0.03, 0.0, 0.0)
    """Middle of the hand capsule from the palm site, m, heading frame."""


class BallOracle:
    """Puts the nearer hand where the ball will cross a plane before the body."""

    def __init__(self, config: BallOracleConfig = BallOracleConfig()) -> None:
        self._config = config

    def act(self, truth: Truth, row: int) -> Array:
        """(7,) the action for one row."""
        if not truth.object_active[row]:
            return np.zeros(7)
        point = self._crossing(truth.object_b[row], truth.object_velocity_b[row])
        target = np.asarray(ACTION_BOX.neutral).copy()
        side = 0 if point[1] > 0 else 1
        target[3 * side : 3 * side + 3] = point - self._config.hand_offset
        return np.clip(ACTION_BOX.to_normalised(target), -1.0, 1.0)

    def _crossing(self, position: Array, velocity: Array) -> Array:
        """Point of the ballistic path nearest to the plane x = reach."""
        t = _LOOKAHEAD[:, None]
        path = position + velocity * t + 0.5 * _GRAVITY * t * t
        out: Array = path[np.argmin(np.abs(path[:, 0] - self._config.reach))]
        return out


@dataclass(frozen=True)
class WallOracleConfig:
    """How the wall oracle braces, m, heading frame."""

    press: float = 0.05
    """How far beyond the wall's surface the hands aim, so that they push."""
    lateral: float = 0.20
    """Hands left and right of the middle."""
    height: float = 0.10
    """Hands above the pelvis."""


class WallOracle:
    """From a push towards the wall onwards, presses both hands on the wall."""

    def __init__(self, config: WallOracleConfig = WallOracleConfig()) -> None:
        self._config = config

    def act(self, truth: Truth, row: int) -> Array:
        """(7,) the action for one row."""
        if not truth.object_active[row]:
            return np.zeros(7)
        c = self._config
        ahead = truth.object_b[row, 0] + c.press
        left, right = (ahead, c.lateral, c.height), (ahead, -c.lateral, c.height)
        target = np.array([*left, *right, ACTION_BOX.neutral[-1]])
        return np.clip(ACTION_BOX.to_normalised(target), -1.0, 1.0)


@dataclass(frozen=True)
class ArchOracleConfig:
    """When and how the arch oracle ducks."""

    before: float = 0.75
    """Ducks while the arch is nearer than this before the pelvis, m."""
    behind: float = 0.30
    """Stays down until the arch is this far behind the pelvis, m."""
    height: float = 0.55
    """Pelvis height under the arch, m."""


class ArchOracle:
    """Squats while the arch is near."""

    def __init__(self, config: ArchOracleConfig = ArchOracleConfig()) -> None:
        self._config = config

    def act(self, truth: Truth, row: int) -> Array:
        """(7,) the action for one row."""
        ahead, c = truth.object_b[row, 0], self._config
        target = np.array(ACTION_BOX.neutral)
        if truth.object_active[row] and -c.behind < ahead < c.before:
            target[6] = c.height
        return ACTION_BOX.to_normalised(target)


class Oracle:
    """The scripted solution of the task that each row plays now."""

    def __init__(self) -> None:
        self._by_task: dict[str, TaskOracle] = {
            "ball": BallOracle(),
            "wall": WallOracle(),
            "arch": ArchOracle(),
        }

    def reset(self, env: VectorEnv, scenarios: Sequence[Scenario]) -> None:
        """Nothing to forget."""

    def reset_rows(self, rows: Sequence[int], scenarios: Sequence[Scenario]) -> None:
        """Nothing to forget."""

    def act(self, env: VectorEnv) -> Array:
        """(B, 7) normalised actions."""
        truth = env.snapshot()
        return np.array(
            [self._by_task[name].act(truth, row) for row, name in enumerate(truth.task)]
        )
