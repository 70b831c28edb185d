"""Simulates and records episodes; the same in every kind of worker."""

from __future__ import annotations

import time
from collections import Counter, defaultdict, deque
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egovcp.data import Episode
from egovcp.sim.base_env import BaseInstance, BaseVectorEnv, Observation, StepResult
from egovcp.sim.policies import RandomWalk
from egovcp.sim.robot_env import make_env
from egovcp.sim.scenario import Scenario
from egovcp.spec import REWARD_TERMS
from egovcp_collect.config import CollectConfig


class Simulation:
    """Up to ``config.num_envs`` robots in parallel; a finished one starts the next episode.

    An episode depends on its scenario only, not on its row or on the other rows.

    Args:
        config: the options in `EPISODE_OPTIONS`, and ``num_envs``.
    """

    def __init__(self, config: CollectConfig) -> None:
        self._config = config
        self._waiting: deque[Scenario] = deque()
        self._policy = RandomWalk(config.eta, config.boundary, config.step_ticks)
        self._env: BaseVectorEnv | None = None
        self._observation: Observation
        self._records: list[EpisodeRecord]

    def add(self, scenarios: Iterable[Scenario]) -> None:
        """Append scenarios to the queue."""
        self._waiting.extend(scenarios)

    @property
    def idle(self) -> bool:
        """Whether no episode is running or waiting."""
        return not self._waiting and (self._env is None or bool(self._env.done.all()))

    def run(self, seconds: float) -> tuple[int, list[tuple[int, Episode]]]:
        """Simulate for about this long, or until idle; returns the planner ticks, summed over the
        robots, and number and content of each finished episode."""
        end = time.monotonic() + seconds
        steps, episodes = 0, list[tuple[int, Episode]]()
        while not self.idle and time.monotonic() < end:
            env = self._start_waiting()
            running, objects = ~env.done, env.known_objects()
            steps += int(running.sum())
            result = env.step(self._policy.act(env))
            for row in np.flatnonzero(running).tolist():
                instance, record = env.instances[row], self._records[row]
                record.add(self._observation, objects[row], result, row, instance)
                if instance.done:
                    episodes.append((instance.scenario.episode, record.episode(instance)))
                    self._records[row] = EpisodeRecord()
            self._observation = result.observation
        return steps, episodes

    def _start_waiting(self) -> BaseVectorEnv:
        """The environment, after waiting episodes were started in its finished rows."""
        config, env = self._config, self._env
        if env is None:
            scenarios = self._take(config.num_envs)
            self._records = [EpisodeRecord() for _ in scenarios]
            env = make_env(config.env, len(scenarios), config.tasks)
            self._env = env
            self._observation = env.reset(scenarios)
            self._policy.reset(env, scenarios)
        elif self._waiting and env.done.any():
            rows = np.flatnonzero(env.done)[: len(self._waiting)].tolist()
            scenarios = self._take(len(rows))
            self._observation = env.reset_rows(rows, scenarios)
            self._policy.reset_rows(rows, scenarios)
        return env

    def _take(self, count: int) -> list[Scenario]:
        return [self._waiting.popleft() for _ in range(min(count, len(self._waiting)))]


class EpisodeRecord:
    """The frames of one episode: (o[t], a[t], r[t], flags)."""

    def __init__(self) -> None:
        self._frames: dict[str, list[Any]] = defaultdict(list)
        self._term_sums: dict[str, float] = defaultdict(float)
        self._term_ticks: Counter[str] = Counter()
        self._contact_ticks: Counter[str] = Counter()

    def add(
        self,
        before: Observation,
        known_object: NDArray[np.float32],
        result: StepResult,
        row: int,
        instance: BaseInstance,
    ) -> None:
        """Append the frame of row ``row`` of the environment: the observation before a step, the
        object (4,) at that time, and the result of the step."""
        columns = instance.task.reward_terms
        terms = {name: float(result.reward_terms[name][row]) for name in columns}
        sums: dict[str, float] = {}  # not from 0.0, which would turn -0.0 into 0.0 in the digest
        for name, column in columns.items():
            sums[column] = sums[column] + terms[name] if column in sums else terms[name]
        values = {
            "depth": before.depth[row].copy(),
            "state": before.state[row].copy(),
            "action": result.sent_action[row].astype(np.float32),
            "reward": np.float32(result.reward[row]),
            "done": result.terminated[row] | result.truncated[row],
            "success": result.success[row],
            "truncated": result.truncated[row],
            "reward_terms": np.array([sums.get(name, 0.0) for name in REWARD_TERMS], np.float32),
            "object": known_object,
        }
        for name, value in values.items():
            self._frames[name].append(value)
        for name in columns:
            self._term_sums[name] += terms[name]
            self._term_ticks[name] += terms[name] != 0
        for group, touched in instance.contacts().items():
            self._contact_ticks[group] += touched

    def episode(self, instance: BaseInstance) -> Episode:
        """The finished episode."""
        frames: dict[str, Any] = {name: np.stack(values) for name, values in self._frames.items()}
        return Episode(
            **frames,
            robot=instance.task.robot_spec(),
            task=instance.scenario.task,
            time_limit=instance.task.ticks_limit,
            metadata={
                "seed": instance.scenario.seed,
                "episode": instance.scenario.episode,
                **instance.metadata,
                "reward_terms": {
                    name: {"sum": self._term_sums[name], "ticks": self._term_ticks[name]}
                    for name in instance.task.reward_terms
                },
                **({"contact_ticks": dict(self._contact_ticks)} if self._contact_ticks else {}),
            },
        )
