"""Simulates a group of episodes side by side and records them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovcp import spec
from egovcp.data import Episode
from egovcp.sim.env import Observation, StepResult, VectorEnv
from egovcp.sim.lane import Lane
from egovcp.sim.policies import Policy
from egovcp.sim.scenario import Scenario


class Interrupted(Exception):
    """The rollout was asked to stop before its episodes were over."""


def simulate(
    env: VectorEnv,
    policy: Policy,
    scenarios: Sequence[Scenario],
    on_tick: Callable[[int], bool] = lambda steps: True,
) -> list[Episode]:
    """One episode per scenario, in order.

    Args:
        env: as many rows as there are scenarios.
        policy: acts on all rows.
        scenarios: the episodes.
        on_tick: called after every planner tick with the number of rows that advanced;
            false stops the rollout.

    Raises:
        Interrupted: ``on_tick`` returned false.
    """
    observation = env.reset(scenarios)
    policy.reset(env, scenarios)
    limits = [lane.task.ticks_limit for lane in env.lanes]
    record = _Record(env.num_envs, max(limits))
    while not env.done.all():
        live = ~env.done
        result = env.step(policy.act(env))
        record.add(observation, result, live)
        observation = result.observation
        if not on_tick(int(live.sum())):
            raise Interrupted
    return [record.episode(row, env.lanes[row]) for row in range(env.num_envs)]


@dataclass(frozen=True)
class _Row:
    """Names of the arrays that `_Record` and `Episode` share, with shape and type per tick."""

    name: str
    shape: tuple[int, ...]
    dtype: type[np.generic]


_ROWS = (
    _Row("depth", (spec.DEPTH_ROWS, spec.DEPTH_COLS), np.uint16),
    _Row("state", (spec.STATE_DIM,), np.float32),
    _Row("action", (spec.ACTION_DIM,), np.float32),
    _Row("reward", (), np.float32),
    _Row("done", (), np.bool_),
    _Row("success", (), np.bool_),
    _Row("truncated", (), np.bool_),
)


class _Record:
    """Arrays (B, T, ...) that fill tick by tick; rows whose episode is over stop growing."""

    def __init__(self, batch: int, ticks: int) -> None:
        self._arrays: dict[str, NDArray[Any]] = {
            row.name: np.zeros((batch, ticks, *row.shape), dtype=row.dtype) for row in _ROWS
        }
        self._terms: list[dict[str, NDArray[np.float64]]] = []
        self._length = np.zeros(batch, dtype=np.int64)

    def add(self, before: Observation, result: StepResult, live: NDArray[np.bool_]) -> None:
        """Store the observation that was acted on, the action sent, and what it brought."""
        rows = np.flatnonzero(live)
        values: dict[str, NDArray[Any]] = {
            "depth": before.depth,
            "state": before.state,
            "action": result.sent_action,
            "reward": result.reward,
            "done": result.terminated | result.truncated,
            "success": result.success,
            "truncated": result.truncated,
        }
        for name, value in values.items():
            self._arrays[name][rows, len(self._terms)] = value[rows]
        self._terms.append(result.reward_terms)
        self._length[rows] += 1

    def episode(self, row: int, lane: Lane) -> Episode:
        """The finished episode of a row."""
        length = int(self._length[row])
        return Episode(
            **{name: array[row, :length].copy() for name, array in self._arrays.items()},
            task=lane.scenario.task,
            time_limit=lane.task.ticks_limit,
            metadata={**_facts(lane), "reward_terms": self._sums(row, lane)},
        )

    def _sums(self, row: int, lane: Lane) -> dict[str, dict[str, float | int]]:
        """Sum of each reward term, and in how many ticks it was not zero."""
        out: dict[str, dict[str, float | int]] = {}
        for name in lane.task.terms:
            values = np.array([terms[name][row] for terms in self._terms])
            out[name] = {"sum": float(values.sum()), "ticks": int(np.count_nonzero(values))}
        return out


def _facts(lane: Lane) -> dict[str, Any]:
    return {
        "seed": lane.scenario.seed,
        "episode": lane.scenario.episode,
        "event_tick": lane.task.event_tick,
        "action_delay": lane.action_delay,
        "image_age": lane.image_age,
        "camera_pitch": lane.camera_pitch,
        "physics": asdict(lane.physics),
    }
