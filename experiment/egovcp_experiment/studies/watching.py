"""Episodes of a policy in simulation, for those who want to look at every tick of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import batched
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp.artifact import Artifact
from egovcp.errors import UsageError
from egovcp.plan import Policy, PolicyStep
from egovcp.policy_options import PlannerOptions
from egovcp.robot.controllers import make_controller
from egovcp.sim.config import EnvConfig, evaluation_config
from egovcp.sim.env import Observation, StepResult, VectorEnv
from egovcp.sim.scenario import Scenario
from egovcp_experiment.studies.study import StudyConfig

STUDIED: Final = 4_000_000_000  # scenarios of no collection, evaluation or training
_ROBOTS: Final = 8  # side by side


@dataclass(frozen=True)
class WatchConfig(StudyConfig):
    """Options of the studies that play."""

    task: str = "ball"
    """Task to play."""
    episodes: int = 16
    """Scenarios."""
    seed: int = 0
    """Which scenarios."""
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    """Changes to the artifact's planner."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation."""

    def artifact(self) -> Artifact:
        """The policy, if the options make sense.

        Raises:
            UsageError: they do not.
            ArtifactError: the artifact is missing, damaged, or of another controller.
        """
        if self.episodes < 1:
            raise UsageError(f"--episodes={self.episodes}: expected at least 1")
        artifact = self.load(self.planner)
        artifact.require_controller(make_controller(self.env.controller).id)
        return artifact

    def empty(self) -> EnvConfig:
        """The scenes without any event."""
        quiet: dict[str, Any] = {
            f"{self.task}_episode": replace(self.env.episode(self.task), empty_probability=1.0)
        }
        return replace(self.env, **quiet)


@dataclass(frozen=True)
class Moment:
    """A tick of all robots: what they saw, what was planned, and before anything was sent."""

    env: VectorEnv
    policy: Policy
    observation: Observation
    step: PolicyStep
    live: NDArray[np.bool_]
    """(E,) robots whose episode is not over."""


class Watcher:
    """Told of every tick; robots keep their row until `watch` hands out others."""

    def begin(self, scenarios: Sequence[Scenario]) -> None:
        """A group of episodes begins, one per row."""

    def before(self, moment: Moment) -> None:
        """A tick is decided, and nothing of it has happened."""

    def after(self, moment: Moment, result: StepResult) -> None:
        """The same tick is over."""


def watch(
    artifact: Artifact,
    env_config: EnvConfig,
    config: WatchConfig,
    watcher: Watcher,
    over: Callable[[], bool] = lambda: False,
) -> None:
    """Play the scenarios of ``config`` in the scenes of ``env_config``, until ``over``."""
    every = [Scenario(config.task, STUDIED + config.seed, i) for i in range(config.episodes)]
    with tqdm(total=len(every), unit="ep", desc=f"watch {config.task}") as bar:
        for part in batched(every, _ROBOTS):
            if over():
                return
            _play(artifact, VectorEnv(env_config, len(part)), part, config.seed, watcher)
            bar.update(len(part))


def _play(
    artifact: Artifact,
    env: VectorEnv,
    scenarios: Sequence[Scenario],
    seed: int,
    watcher: Watcher,
) -> None:
    policy = artifact.make_policy(len(scenarios), seed)
    observation = env.reset(scenarios)
    watcher.begin(scenarios)
    while not env.done.all():
        step = policy.act(observation.depth, observation.state)
        moment = Moment(env, policy, observation, step, ~env.done)
        watcher.before(moment)
        result = env.step(step.action)
        policy.advance(result.sent_action)
        watcher.after(moment, result)
        observation = result.observation
