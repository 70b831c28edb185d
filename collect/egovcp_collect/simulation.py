"""Robots that simulate one episode after the other; the same in every kind of worker."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from egovcp.data import Episode
from egovcp.sim.env import Observation, VectorEnv
from egovcp.sim.policies import RandomWalk
from egovcp.sim.scenario import Scenario
from egovcp.spec import TASKS
from egovcp_collect.config import CollectConfig
from egovcp_collect.record import Record

#: Looks at the robots; the second argument (B,) says whose episode is not over.
type Watch = Callable[[VectorEnv, NDArray[np.bool_]], None]


@dataclass
class Progress:
    """What a while of simulation brought."""

    steps: int = 0
    """Planner ticks, all robots together."""
    episodes: list[tuple[int, Episode]] = field(default_factory=list)
    """Number and content of each episode that ended."""


class Simulation:
    """Up to ``config.num_envs`` robots; one whose episode is over begins the next at once.

    An episode does not depend on its neighbours: it does not matter which robot plays it, or when.

    Args:
        config: what shapes the episodes.
        watch: shown the robots before each tick, as the row that the tick makes finds them.
        pictures: false: depth stays empty, which is quicker; all else is the same.
    """

    def __init__(
        self, config: CollectConfig, watch: Watch | None = None, pictures: bool = True
    ) -> None:
        self._config = config
        self._watch = watch
        self._pictures = pictures
        self._waiting: deque[Scenario] = deque()
        self._policy = RandomWalk(config.eta, config.boundary, config.step_ticks)
        self._env: VectorEnv | None = None
        self._observation: Observation
        self._record: Record

    def add(self, scenarios: Iterable[Scenario]) -> None:
        """Play these, too."""
        self._waiting.extend(scenarios)

    @property
    def idle(self) -> bool:
        """Whether every episode is over and none waits."""
        return not self._waiting and (self._env is None or bool(self._env.done.all()))

    def advance(self, seconds: float) -> Progress:
        """Simulate for about this long, or until nothing is left to do."""
        end = time.monotonic() + seconds
        progress = Progress()
        while not self.idle and time.monotonic() < end:
            self._tick(progress)
        return progress

    def _tick(self, progress: Progress) -> None:
        env = self._filled()
        live = ~env.done
        if self._watch is not None:
            self._watch(env, live)
        result = env.step(self._policy.act(env))
        self._record.add(self._observation, result, live)
        self._observation = result.observation
        progress.steps += int(live.sum())
        for row in np.flatnonzero(live):
            instance = env.instances[row]
            self._record.touch(row, instance)
            if instance.done:
                episode = self._record.episode(row, instance)
                progress.episodes.append((instance.scenario.episode, episode))

    def _filled(self) -> VectorEnv:
        """The environment, every robot busy as long as episodes wait."""
        if self._env is None:
            return self._begin()
        if self._waiting:
            rows = np.flatnonzero(self._env.done)[: len(self._waiting)]
            if len(rows):
                self._refill(self._env, rows.tolist())
        return self._env

    def _begin(self) -> VectorEnv:
        config = self._config
        first = self._next(min(config.num_envs, len(self._waiting)))
        limits = [config.env.episode(task).ticks for task in TASKS]
        self._record = Record(len(first), max(limits))
        self._env = VectorEnv(config.env, len(first), render_depth=self._pictures)
        self._observation = self._env.reset(first)
        self._policy.reset(self._env, first)
        return self._env

    def _refill(self, env: VectorEnv, rows: Sequence[int]) -> None:
        scenarios = self._next(len(rows))
        self._observation = env.reset_rows(rows, scenarios)
        self._policy.reset_rows(rows, scenarios)
        self._record.restart(np.asarray(rows, dtype=np.intp))

    def _next(self, count: int) -> list[Scenario]:
        return [self._waiting.popleft() for _ in range(count)]
