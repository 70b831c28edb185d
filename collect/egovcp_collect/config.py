"""Options of `egovcp-collect`, and which episodes they ask for."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Literal

from egovcp.data import DatasetConfig
from egovcp.errors import UsageError, suggest
from egovcp.sim.config import EnvConfig
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_ETA, ACTION_RATE_LIMIT, TASKS

ALL_TASKS = "all"


@dataclass(frozen=True)
class MixConfig:
    """Share of each task under --task=all, in any unit."""

    ball: float = 1.0
    """Weight of ball episodes."""
    wall: float = 1.0
    """Weight of wall episodes."""
    arch: float = 1.0
    """Weight of arch episodes."""


@dataclass(frozen=True)
class CollectConfig:
    """Simulate episodes under the random walk of the paper; write them as a LeRobot dataset."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """Where the dataset goes; without a root, into LeRobot's local folder under its id."""
    task: str = "ball"
    """Task to collect: ball, wall, arch, or all of them in turn."""
    mix: MixConfig = field(default_factory=MixConfig)
    """Shares of the tasks under --task=all."""
    episodes: int = 200
    """Number of episodes."""
    seed: int = 0
    """Episode i is a function of (seed, i) alone, whatever the number of workers."""
    num_workers: int = 0
    """Processes that simulate; 0: one per processor core."""
    num_envs: int = 16
    """Robots that each process simulates side by side."""
    eta: float = ACTION_ETA
    """Largest step of the random walk, action box units per planner tick (40 ms)."""
    boundary: Literal["reflect", "clip"] = "reflect"
    """What keeps the walk inside the action box; clipping piles it up on the walls."""
    env: EnvConfig = field(default_factory=EnvConfig)
    """Scenes, sensors, delays and randomisation."""

    def check(self) -> None:
        """Raise `UsageError` for values that make no sense."""
        choices = (*TASKS, ALL_TASKS)
        if self.task not in choices:
            raise UsageError(f"unknown task --task={self.task}{suggest(self.task, choices)}")
        for name, least in (("episodes", 1), ("seed", 0), ("num_workers", 0), ("num_envs", 1)):
            value = getattr(self, name)
            if value < least:
                raise UsageError(f"--{name}={value}: expected at least {least}")
        if not 0 < self.eta <= ACTION_RATE_LIMIT:
            raise UsageError(
                f"--eta={self.eta}: expected more than 0 and at most {ACTION_RATE_LIMIT}, the "
                "rate limit that collection and deployment share"
            )
        if min(self._weights()) < 0 or sum(self._weights()) <= 0:
            raise UsageError(f"{self.mix}: expected weights of at least 0, and one above it")
        if self.dataset.revision:
            raise UsageError("--dataset.revision has no meaning for a new dataset; drop it")

    @property
    def workers(self) -> int:
        """Number of processes; no more than there are groups of episodes."""
        wanted = self.num_workers or len(os.sched_getaffinity(0))
        return min(wanted, len(self.groups()))

    def scenarios(self) -> tuple[Scenario, ...]:
        """The episodes in order. Tasks interleave so that every prefix holds their shares."""
        if self.task != ALL_TASKS:
            return tuple(Scenario(self.task, self.seed, i) for i in range(self.episodes))
        weights = self._weights()
        counts = [0] * len(TASKS)
        chosen = []
        for i in range(self.episodes):
            due = [w * (i + 1) / sum(weights) - n for w, n in zip(weights, counts, strict=True)]
            k = max(range(len(TASKS)), key=due.__getitem__)
            counts[k] += 1
            chosen.append(Scenario(TASKS[k], self.seed, i))
        return tuple(chosen)

    def groups(self) -> list[tuple[Scenario, ...]]:
        """The episodes in groups that are simulated side by side."""
        scenarios, size = self.scenarios(), self.num_envs
        return [scenarios[i : i + size] for i in range(0, len(scenarios), size)]

    def _weights(self) -> tuple[float, ...]:
        return tuple(getattr(self.mix, task) for task in TASKS)
