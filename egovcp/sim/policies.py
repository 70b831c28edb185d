"""Reference policies that need no learning: hold, constant, the data's random walk.

A policy sees the environment, scripted oracles even its truth, and returns normalised
actions (B, 7); the environment applies the same delays and rate limits to all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import UsageError
from egovcp.sim.env import VectorEnv
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_DIM, ACTION_ETA, reflect

Array = NDArray[np.float64]


class Policy(Protocol):
    """Acts on a whole batch."""

    def reset(self, env: VectorEnv, scenarios: Sequence[Scenario]) -> None:
        """Every row has just begun one of ``scenarios``."""
        ...

    def reset_rows(self, rows: Sequence[int], scenarios: Sequence[Scenario]) -> None:
        """Only ``rows`` have begun new episodes."""
        ...

    def act(self, env: VectorEnv) -> Array:
        """(B, 7) normalised actions for the present planner tick."""
        ...


class Constant:
    """The same action always; what a fixed guard or a permanent crouch would earn."""

    def __init__(self, action: Sequence[float] | NDArray[np.floating]) -> None:
        self._action = np.asarray(action, dtype=np.float64)
        if self._action.shape != (ACTION_DIM,):
            raise UsageError(f"expected {ACTION_DIM} numbers, found shape {self._action.shape}")

    def reset(self, env: VectorEnv, scenarios: Sequence[Scenario]) -> None:
        """Nothing to forget."""

    def reset_rows(self, rows: Sequence[int], scenarios: Sequence[Scenario]) -> None:
        """Nothing to forget."""

    def act(self, env: VectorEnv) -> Array:
        """(B, 7) the action."""
        return np.tile(self._action, (env.num_envs, 1))


class Hold(Constant):
    """The neutral pose."""

    def __init__(self) -> None:
        super().__init__(np.zeros(ACTION_DIM))


class RandomWalk:
    """The behaviour policy of the data: a_t = a_{t-1} + eta delta, delta ~ U(-1, 1)^7.

    (Paper section III-B.) ``reflect`` folds what leaves the box back inside, which keeps
    the walk's distribution uniform; ``clip`` piles it up on the walls.
    """

    def __init__(
        self, eta: float = ACTION_ETA, bounds: Literal["reflect", "clip"] = "reflect"
    ) -> None:
        self._eta = eta
        self._bounds = bounds
        self._action = np.zeros((0, ACTION_DIM))
        self._rngs: list[np.random.Generator] = []

    def reset(self, env: VectorEnv, scenarios: Sequence[Scenario]) -> None:
        """Every row starts from neutral with its scenario's own randomness."""
        self._action = np.zeros((len(scenarios), ACTION_DIM))
        self._rngs = [scenario.rng("policy") for scenario in scenarios]

    def reset_rows(self, rows: Sequence[int], scenarios: Sequence[Scenario]) -> None:
        """``rows`` start from neutral with their scenarios' own randomness."""
        for row, scenario in zip(rows, scenarios, strict=True):
            self._action[row] = 0.0
            self._rngs[row] = scenario.rng("policy")

    def act(self, env: VectorEnv) -> Array:
        """(B, 7) the next step of each row's walk."""
        delta = np.array([rng.uniform(-1.0, 1.0, ACTION_DIM) for rng in self._rngs])
        fold = reflect if self._bounds == "reflect" else _clip
        self._action[:] = fold(self._action + self._eta * delta)
        return self._action.copy()


def _clip(action: Array) -> Array:
    return np.clip(action, -1.0, 1.0)
