"""Policies that need no learning: constant actions, random walks, and scripted oracles.

A policy returns normalised actions (B, A). The environment applies the same delays and rate limits
to all of them; only oracles read the simulator's privileged state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import UsageError
from egovcp.sim.base_env import BaseVectorEnv, reporting_plugin_errors
from egovcp.sim.scenario import Scenario
from egovcp.sim.tasks.base_task import BaseTask
from egovcp.sim.tasks.registry import find_task
from egovcp.spec import ACTION_DIM, ACTION_ETA, reflect

Array = NDArray[np.float64]


class EnvPolicy(ABC):
    """Acts on all rows of an environment; by default without memory."""

    def reset(  # noqa: B027 - optional
        self, env: BaseVectorEnv, scenarios: Sequence[Scenario]
    ) -> None:
        """Start one of ``scenarios`` in each row."""

    def reset_rows(  # noqa: B027 - optional
        self, rows: Sequence[int], scenarios: Sequence[Scenario]
    ) -> None:
        """Start an episode in each of ``rows``."""

    @abstractmethod
    def act(self, env: BaseVectorEnv) -> Array:
        """(B, A) normalised actions for this planner tick."""


class Constant(EnvPolicy):
    """Always the same action."""

    def __init__(self, action: Sequence[float] | NDArray[np.floating]) -> None:
        self._action = np.asarray(action, dtype=np.float64)

    def act(self, env: BaseVectorEnv) -> Array:
        return np.tile(self._action, (env.num_envs, 1))


class Hold(EnvPolicy):
    """The neutral pose."""

    def act(self, env: BaseVectorEnv) -> Array:
        return np.zeros((env.num_envs, env.robot.action_dim))


def require_ordered_steps(step_ticks: tuple[int, int]) -> tuple[int, int]:
    """The interval of `RandomWalk`; raises `UsageError` unless the first is at most the second."""
    shortest, longest = step_ticks
    if shortest > longest:
        raise UsageError(
            f"--step_ticks={[shortest, longest]}: expected 1 <= shortest <= longest, planner ticks"
        )
    return shortest, longest


class RandomWalk(EnvPolicy):
    """The behaviour policy of the data: a_t = a_{t-1} + eta delta, delta ~ U(-1, 1)^A.

    The defaults are the paper's (section III-B).

    Args:
        eta: largest change of an action per step; the environment sends a step beyond its rate
            limit as a ramp.
        boundary: ``reflect`` folds actions outside the box back inside, which keeps their
            distribution uniform; ``clip`` accumulates them on its walls.
        step_ticks: least and most ticks from one step to the next, sampled for each step.
    """

    def __init__(
        self,
        eta: float = ACTION_ETA,
        boundary: Literal["reflect", "clip"] = "reflect",
        step_ticks: tuple[int, int] = (1, 1),
    ) -> None:
        self._eta = eta
        self._boundary = boundary
        self._step_ticks = step_ticks
        self._action: Array = np.zeros((0, ACTION_DIM))
        self._wait = np.zeros(0, dtype=np.int64)  # ticks until the next step
        self._rngs: list[np.random.Generator] = []

    def reset(self, env: BaseVectorEnv, scenarios: Sequence[Scenario]) -> None:
        """See `EnvPolicy`; rows start from neutral."""
        self._action = np.zeros((len(scenarios), env.robot.action_dim))
        self._wait = np.zeros(len(scenarios), dtype=np.int64)
        self._rngs = [scenario.rng("policy") for scenario in scenarios]

    def reset_rows(self, rows: Sequence[int], scenarios: Sequence[Scenario]) -> None:
        """See `EnvPolicy`; rows start from neutral."""
        for row, scenario in zip(rows, scenarios, strict=True):
            self._action[row] = 0.0
            self._wait[row] = 0
            self._rngs[row] = scenario.rng("policy")

    def start_at(self, action: Array, rngs: Sequence[np.random.Generator]) -> None:
        """Start each row at ``action`` (B, A), at a random time between two of its steps.

        The row's further steps are sampled from its generator in ``rngs``.
        """
        self._action = np.zeros_like(action, np.float64)
        self._wait = np.zeros(len(action), dtype=np.int64)
        self._rngs = list(rngs)
        self.start_rows_at(range(len(action)), action)

    def start_rows_at(self, rows: Sequence[int], action: Array) -> None:
        """As `start_at` for ``rows``, with their present generators."""
        for row, at in zip(rows, action, strict=True):
            self._action[row] = at
            self._wait[row] = self._remaining_wait(self._rngs[row])

    def _remaining_wait(self, rng: np.random.Generator) -> int:
        """Ticks to the next step, seen at a random time: long waits are seen more often."""
        least, most = self._step_ticks
        waits = np.arange(least, most + 1)
        return int(rng.integers(rng.choice(waits, p=waits / waits.sum())))

    def act(self, env: BaseVectorEnv) -> Array:
        delta = np.array([self._delta(row) for row in range(len(self._rngs))])
        action = self._action + self._eta * delta
        reflects = self._boundary == "reflect"
        self._action[:] = reflect(action) if reflects else np.clip(action, -1.0, 1.0)
        return self._action.copy()

    def _delta(self, row: int) -> Array:
        """(A,) the change of a row's action; zeros between two steps."""
        if self._wait[row] > 0:
            self._wait[row] -= 1
            return np.zeros(self._action.shape[1])
        rng, (least, most) = self._rngs[row], self._step_ticks
        if most > 1:  # else nothing is sampled, as in the paper's walk
            self._wait[row] = rng.integers(least, most, endpoint=True) - 1
        return rng.uniform(-1.0, 1.0, self._action.shape[1])


class Oracle(EnvPolicy):
    """The scripted solution of the current task of every row, `Task.oracle`.

    Raises:
        UsageError: a task has none.
    """

    def reset(self, env: BaseVectorEnv, scenarios: Sequence[Scenario]) -> None:
        for task in dict.fromkeys(scenario.task for scenario in scenarios):
            if not find_task(task).has_oracle():
                raise UsageError(f"task {task} has no oracle; choose another controller")

    def act(self, env: BaseVectorEnv) -> Array:
        return np.array([_oracle_action(instance.task) for instance in env.instances])


@reporting_plugin_errors()
def _oracle_action(task: BaseTask) -> Array:
    action = np.asarray(task.oracle(), np.float64)
    if action.shape != (task.robot_spec().action_dim,) or not np.isfinite(action).all():
        expected = f"{task.robot_spec().action_dim} finite numbers"
        raise task.error(f"its oracle returns {action.tolist()}, expected {expected}")
    return action
