"""Options of `egovcp-collect`, and the scenarios that they select."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

from egovcp.bounds import bounded, check_bounds, require_cores
from egovcp.data import DatasetConfig
from egovcp.data.schema import SHARD_EPISODES
from egovcp.errors import UsageError, suggest
from egovcp.hardware import available_cores
from egovcp.sim.config import EnvConfig, require_memory_for_robots
from egovcp.sim.scenario import Scenario
from egovcp.spec import ACTION_ETA, ACTION_RATE_LIMIT, TASKS

ALL_TASKS: Final = "all"
#: Options that determine the content of an episode; the others only schedule the work.
EPISODE_OPTIONS: Final = ("task", "mix", "seed", "eta", "step_ticks", "boundary", "env")


@dataclass(frozen=True)
class MixConfig:
    """Relative weight of each task under --task=all."""

    ball: float = bounded(1.0, least=0)
    """Weight of ball episodes."""
    wall: float = bounded(1.0, least=0)
    """Weight of wall episodes."""
    arch: float = bounded(1.0, least=0)
    """Weight of arch episodes."""


@dataclass(frozen=True)
class CollectConfig:
    """Simulate episodes under the random walk of the paper; write them as a LeRobot dataset."""

    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    """The new dataset; without a root it goes to LeRobot's local folder under its id."""
    task: str = "ball"
    """Task to collect: ball, wall, arch, or all of them interleaved."""
    mix: MixConfig = field(default_factory=MixConfig)
    """Weights of the tasks under --task=all."""
    episodes: int = bounded(200, least=1, most=10**6)
    """Number of episodes, including those that --resume finds."""
    resume: bool = False
    """Continue an existing collection, if any; with more episodes, extend the dataset."""
    shard_episodes: int = bounded(SHARD_EPISODES, least=1, most=65_536)
    """Episodes per data file; the dataset grows by one such shard at a time."""
    seed: int = bounded(0, least=0)
    """Episode i depends on (seed, i) only, not on the number of workers."""
    backend: Literal["local", "ray"] = "local"
    """Where the workers run: as processes of this machine, or on a Ray cluster (RAY_ADDRESS; needs
    egovcp-collect[ray])."""
    num_workers: int = bounded(0, least=0, most=65_536)
    """Simulation processes; 0: one per processor core, of the cluster under --backend=ray."""
    worker_timeout: float = bounded(120.0, least=1)
    """Replace a worker that sends no report for this long, s."""
    num_envs: int = bounded(16, least=1, most=65_536)
    """Robots that each process simulates in parallel."""
    eta: float = bounded(ACTION_ETA, above=0, most=2)
    """Largest step of the random walk, action box units; a step above the rate limit of 0.32 per
    planner tick (40 ms) is sent as a ramp."""
    step_ticks: tuple[int, int] = bounded((1, 1), least=1, most=100_000)
    """Shortest and longest interval between steps of the walk, planner ticks; (1, 1) is the
    paper's walk."""
    boundary: Literal["reflect", "clip"] = "reflect"
    """How the walk stays inside the action box; clipping accumulates actions on its faces."""
    env: EnvConfig = field(default_factory=EnvConfig)
    """Scenes, sensors, delays and randomisation."""

    def check(self) -> None:
        """Raise `UsageError` for invalid values and combinations."""
        check_bounds(self, "--")
        if self.backend == "local":  # a cluster has other cores and other memory
            require_cores("--num_workers", self.num_workers)
            workers = self.num_workers or available_cores()
            robots = min(self.num_envs * workers, self.episodes)
            require_memory_for_robots("--num_envs", self.num_envs, robots)
        choices = (*TASKS, ALL_TASKS)
        if self.task not in choices:
            raise UsageError(f"unknown task --task={self.task}{suggest(self.task, choices)}")
        shortest, longest = self.step_ticks
        if shortest > longest:
            raise UsageError(
                f"--step_ticks={[shortest, longest]}: expected 1 <= shortest <= longest, planner "
                "ticks"
            )
        reachable = min(2.0, shortest * ACTION_RATE_LIMIT)
        if self.eta > reachable:
            raise UsageError(
                f"--eta={self.eta}: expected more than 0 and at most {reachable:g}, which is what "
                f"the rate limit of {ACTION_RATE_LIMIT} per tick allows within "
                f"--step_ticks={[shortest, longest]}"
            )
        if not any(self._weights()):
            raise UsageError(f"{self.mix}: expected at least one of the weights above 0")
        if self.dataset.revision:
            raise UsageError("--dataset.revision has no meaning for a new dataset; drop it")

    def scenarios(self) -> tuple[Scenario, ...]:
        """The episodes in order. Tasks interleave so that every prefix has the shares of `mix`."""
        if self.task != ALL_TASKS:
            return tuple(Scenario(self.task, self.seed, i) for i in range(self.episodes))
        weights = self._weights()
        counts = [0] * len(TASKS)
        scenarios = []
        for i in range(self.episodes):
            due = [w * (i + 1) / sum(weights) - n for w, n in zip(weights, counts, strict=True)]
            k = max(range(len(TASKS)), key=due.__getitem__)
            counts[k] += 1
            scenarios.append(Scenario(TASKS[k], self.seed, i))
        return tuple(scenarios)

    def _weights(self) -> tuple[float, ...]:
        return tuple(getattr(self.mix, task) for task in TASKS)
