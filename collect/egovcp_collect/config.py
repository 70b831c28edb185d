"""Options of `egovcp-collect`, and the scenarios that they select."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from egovcp.bounds import MAX_PER_CORE, bounded, check_bounds, check_cores
from egovcp.data.schema import SHARD_EPISODES
from egovcp.errors import UsageError, suggest
from egovcp.hardware import available_cores
from egovcp.sim.config import EnvConfig, require_memory_for_robots, short_episodes
from egovcp.sim.policies import require_ordered_steps
from egovcp.sim.scenario import Scenario, require_training_seed
from egovcp.sim.tasks.registry import DEFAULT_TASK, select_tasks
from egovcp.spec import ACTION_ETA, ACTION_RATE_LIMIT, HELD_ETA, HELD_TICKS

#: Options that determine the content of an episode; the others only schedule the work.
EPISODE_OPTIONS: Final = ("task", "mix", "seed", "eta", "step_ticks", "boundary", "env")


@dataclass(frozen=True)
class NewDatasetConfig:
    """Where the new dataset is written."""

    repo_id: str = ""
    """Dataset id, `user/name`; without root it names LeRobot's local folder."""
    root: str = ""
    """Folder of the new dataset; empty: $HF_LEROBOT_HOME/REPO_ID."""


@dataclass(frozen=True)
class CollectConfig:
    """Simulate episodes under random actions; write them as a LeRobot dataset."""

    dataset: NewDatasetConfig = field(default_factory=NewDatasetConfig)
    """Where the new dataset is written."""
    task: str = DEFAULT_TASK
    """Task to collect: one of `egovcp-task list`, package.module:Class, several as ball,wall, or
    all. Several are interleaved."""
    preset: str = "default"
    """Starting point of all options: default (actions change every 5 to 15 planner ticks, short
    episodes), or paper (actions change at every planner tick, with full-length episodes, as in
    evaluation)."""
    mix: dict[str, float] = bounded({}, least=0)
    """Relative share of planner ticks per task, '{ball: 2}'; 1 for tasks not listed."""
    episodes: int = bounded(200, least=1, most=10**6)
    """Number of episodes, including those that --resume finds."""
    resume: bool = False
    """Continue an existing collection, if any; with more episodes, extend the dataset."""
    shard_episodes: int = bounded(SHARD_EPISODES, least=1, most=65_536)
    """Episodes per data file; the dataset grows by one such shard at a time."""
    seed: int = bounded(0, least=0)
    """With the other options fixed, episode i depends only on (seed, i), not on --episodes,
    --num_workers or --num_envs."""
    num_workers: int = bounded(0, least=0, per_core=MAX_PER_CORE)
    """Simulation processes; 0: one per processor core."""
    worker_timeout: float = bounded(120.0, least=1)
    """Replace a worker that sends no report for this long, s."""
    num_envs: int = bounded(16, least=1, most=65_536)
    """Robots that each process simulates in parallel."""
    eta: float = bounded(HELD_ETA, above=0, most=2)
    """Largest step of the random walk, normalised action units ([-1, 1]; 1 is half the range); a
    step above the rate limit of 0.32 per planner tick (40 ms) is sent as a ramp."""
    step_ticks: tuple[int, int] = bounded(HELD_TICKS, least=1, most=100_000)
    """Shortest and longest interval between steps of the walk, planner ticks; (1, 1) needs
    --eta of 0.32 or less; --preset=paper is the paper's walk."""
    boundary: Literal["reflect", "clip"] = "reflect"
    """How the walk stays inside the action box; clipping accumulates actions on its faces."""
    env: EnvConfig = field(default_factory=short_episodes)
    """Scenes, sensors, delays and randomisation."""

    def check(self) -> None:
        """Raise `UsageError` for invalid values and combinations."""
        check_bounds(self, "--")
        check_cores(self, "--")
        if self.preset not in PRESETS:
            raise UsageError(f"unknown --preset={self.preset}{suggest(self.preset, PRESETS)}")
        require_training_seed(self.seed)
        workers = self.num_workers or available_cores()
        robots = min(self.num_envs * workers, self.episodes)
        require_memory_for_robots("--num_envs", self.num_envs, robots)
        tasks = select_tasks(self.task, training=True)
        if unknown := sorted(set(self.mix) - set(tasks)):
            raise UsageError(
                f"--mix.{unknown[0]}: not a task of --task={self.task}; expected one of "
                f"{', '.join(tasks)}"
            )
        shortest, longest = require_ordered_steps(self.step_ticks)
        reachable = min(2.0, shortest * ACTION_RATE_LIMIT)
        if self.eta > reachable:
            raise UsageError(
                f"--eta={self.eta}: expected more than 0 and at most {reachable:g}, which is what "
                f"the rate limit of {ACTION_RATE_LIMIT} per tick allows within "
                f"--step_ticks={[shortest, longest]}"
            )
        if not self._weights():
            raise UsageError(f"--mix={self.mix}: expected at least one weight above 0")

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks of the episodes."""
        return tuple(self._weights())

    def scenarios(self) -> tuple[Scenario, ...]:
        """The episodes in order. Tasks interleave so that every prefix has the shares of `mix`.

        The planned length of an episode counts, whether or not a fall ends it earlier.
        """
        weights = {
            task: weight / self.env.episode(task).ticks for task, weight in self._weights().items()
        }
        total, counts = sum(weights.values()), dict.fromkeys(weights, 0)
        scenarios = []
        for i in range(self.episodes):
            task = max(weights, key=lambda t: weights[t] * (i + 1) / total - counts[t])
            counts[task] += 1
            scenarios.append(Scenario(task, self.seed, i))
        return tuple(scenarios)

    def _weights(self) -> dict[str, float]:
        """Task -> weight, of those above 0."""
        weights = {task: self.mix.get(task, 1.0) for task in select_tasks(self.task, training=True)}
        return {task: weight for task, weight in weights.items() if weight}


def paper() -> CollectConfig:
    """The paper's random walk (section III-B), in episodes as they are evaluated."""
    return CollectConfig(preset="paper", eta=ACTION_ETA, step_ticks=(1, 1), env=EnvConfig())


#: Name -> function that returns the complete configuration.
PRESETS: Final[Mapping[str, Callable[[], CollectConfig]]] = {
    "default": CollectConfig,
    "paper": paper,
}
