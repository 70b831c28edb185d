"""Reference policies that need no learning: hold, constant, random walks.

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

    By default the paper's (section III-B). ``reflect`` folds what leaves the box back inside,
    which keeps the walk's distribution uniform; ``clip`` piles it up on the walls. The next step
    comes ``step_ticks`` (least, most) ticks after the last one, drawn anew each time. A step
    beyond the environment's rate limit is sent as a ramp: an action then says where the hands will
    be for a while, and its return what that was worth.
    """

    def __init__(
        self,
        eta: float = ACTION_ETA,
        bounds: Literal["reflect", "clip"] = "reflect",
        step_ticks: tuple[int, int] = (1, 1),
    ) -> None:
        self._eta = eta
        self._bounds = bounds
        self._step_ticks = step_ticks
        self._action = np.zeros((0, ACTION_DIM))
        self._wait = np.zeros(0, dtype=np.int64)  # ticks until the next step
        self._rngs: list[np.random.Generator] = []

    def reset(self, env: VectorEnv, scenarios: Sequence[Scenario]) -> None:
        """Every row starts from neutral with its scenario's own randomness."""
        self._action = np.zeros((len(scenarios), ACTION_DIM))
        self._wait = np.zeros(len(scenarios), dtype=np.int64)
        self._rngs = [scenario.rng("policy") for scenario in scenarios]

    def reset_rows(self, rows: Sequence[int], scenarios: Sequence[Scenario]) -> None:
        """``rows`` start from neutral with their scenarios' own randomness."""
        for row, scenario in zip(rows, scenarios, strict=True):
            self._action[row] = 0.0
            self._wait[row] = 0
            self._rngs[row] = scenario.rng("policy")

    def stand(self, action: Array, rngs: Sequence[np.random.Generator]) -> None:
        """Every row stands at its ``action`` (B, 7), as if looked at by chance: somewhere in a
        rest, a long one more likely than a short one. What follows is drawn from its own ``rngs``.
        """
        self._action = np.zeros((len(action), ACTION_DIM))
        self._wait = np.zeros(len(action), dtype=np.int64)
        self._rngs = list(rngs)
        self.stand_rows(range(len(action)), action)

    def stand_rows(self, rows: Sequence[int], action: Array) -> None:
        """`stand`, for ``rows`` alone, with the randomness they have."""
        for row, at in zip(rows, action, strict=True):
            self._action[row] = at
            self._wait[row] = self._rest(self._rngs[row])

    def _rest(self, rng: np.random.Generator) -> int:
        """What is left of a rest, ticks."""
        least, most = self._step_ticks
        rests = np.arange(least, most + 1)
        return int(rng.integers(rng.choice(rests, p=rests / rests.sum())))

    def act(self, env: VectorEnv) -> Array:
        """(B, 7) the next step of each row's walk."""
        delta = np.array([self._delta(row) for row in range(len(self._rngs))])
        fold = reflect if self._bounds == "reflect" else _clip
        self._action[:] = fold(self._action + self._eta * delta)
        return self._action.copy()

    def _delta(self, row: int) -> Array:
        """(7,) of one robot; zeros between two steps."""
        if self._wait[row] > 0:
            self._wait[row] -= 1
            return np.zeros(ACTION_DIM)
        rng, (least, most) = self._rngs[row], self._step_ticks
        if most > 1:  # the paper's walk draws nothing else
            self._wait[row] = rng.integers(least, most, endpoint=True) - 1
        return rng.uniform(-1.0, 1.0, ACTION_DIM)


def _clip(action: Array) -> Array:
    return np.clip(action, -1.0, 1.0)
