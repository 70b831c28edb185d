"""Shared parts of the studies: options, result file, and closed-loop play."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import batched
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from egovcp.artifact import Artifact
from egovcp.bounds import bounded
from egovcp.cli import run_command
from egovcp.errors import UsageError
from egovcp.eval_scores import Array
from egovcp.files import user_path, write_json
from egovcp.model import Carry
from egovcp.outputs import require_writable
from egovcp.plan import Policy, PolicyStep
from egovcp.policy_options import PlannerOptions, PolicyOptions, load_policy
from egovcp.robot.controllers import make_controller
from egovcp.sim.base_env import Observation, StepResult
from egovcp.sim.config import EnvConfig, evaluation_config
from egovcp.sim.env import PrivilegedState, VectorEnv
from egovcp.sim.scenario import STUDIES, Scenario
from egovcp.sim.tasks.registry import DEFAULT_TASK
from egovcp_experiment.cell import RESULT

_ENVS: Final = 8  # robots in parallel


@dataclass(frozen=True)
class StudyConfig:
    """Options of every study."""

    output_dir: str = ""
    """New folder for the result."""
    policy: PolicyOptions = field(default_factory=PolicyOptions)
    """Policy to study."""
    planner: PlannerOptions = field(default_factory=PlannerOptions)
    """Changes to the policy's planner."""

    @property
    def folder(self) -> Path:
        """The folder for the result."""
        return user_path(self.output_dir)

    def check(self) -> None:
        """Check the options before the work; `make_main` calls it.

        Raises:
            UsageError: no folder is named, or it holds a result; or invalid values.
            EnvironmentFailure: the folder cannot be written.
        """
        if not self.output_dir:
            raise UsageError("--output_dir is missing; name a new folder")
        if (self.folder / RESULT).exists():
            raise UsageError(
                f"--output_dir={self.output_dir} holds a result already; name a new folder"
            )
        require_writable(self.folder)

    def load(self) -> Artifact:
        """The policy with the changed planner.

        Raises:
            UsageError: none is named, or the changes are invalid.
            ArtifactError: it is missing or damaged.
        """
        self.policy.require()
        return load_policy(self.policy, self.planner)

    def write(self, metrics: Mapping[str, Any]) -> None:
        """Write the result into the folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.folder / RESULT, metrics)


@dataclass(frozen=True)
class ScenariosConfig(StudyConfig):
    """Options of the studies in simulation, of one task or of several."""

    episodes: int = bounded(16, least=1)
    """Number of scenarios of a task."""
    seed: int = bounded(0, least=0)
    """Seed of the scenarios."""
    env: EnvConfig = field(default_factory=evaluation_config)
    """Scenes, sensors, delays and randomisation."""

    def load(self) -> Artifact:
        """As `StudyConfig.load`; refuses a policy of another low-level controller."""
        artifact = super().load()
        artifact.require_controller(make_controller(self.env.controller).id)
        return artifact


@dataclass(frozen=True)
class SimStudyConfig(ScenariosConfig):
    """Options of the studies of one task in simulation."""

    task: str = DEFAULT_TASK
    """Task to play."""

    def require_task(self, known: Sequence[str] | Mapping[str, object]) -> None:
        """Raise `UsageError` unless the task is one of ``known``."""
        if self.task not in known:
            raise UsageError(f"--task={self.task}: expected one of {', '.join(known)}")

    def empty_scenes(self) -> EnvConfig:
        """The scenes without events."""
        name = f"{self.task}_episode"
        empty = replace(self.env.episode(self.task), empty_probability=1.0)
        return replace(self.env, **{name: empty})  # type: ignore[arg-type]


def make_main[C: StudyConfig](
    name: str, config: type[C], measure: Callable[[C], None]
) -> Callable[..., int]:
    """The `main` of a study's module, which returns the exit code."""

    def run(options: C) -> None:
        options.check()
        measure(options)

    def main(argv: Sequence[str] | None = None) -> int:
        prog = f"python -m egovcp_experiment.studies.{name}"
        return run_command(config, run, argv, prog=prog)

    return main


@dataclass(frozen=True)
class PlayedStep:
    """A step of all robots, after its execution."""

    scenarios: Sequence[Scenario]
    """One per row."""
    env: VectorEnv
    """After the step."""
    state: PrivilegedState
    """Before the step."""
    carry: Carry
    """Before the step, with its observation."""
    tick: NDArray[np.int64]
    """(E,) before the step."""
    sent_before: Array
    """(E, 7) action sent in the step before; neutral in the first step."""
    live: list[int]
    """Rows whose episode was not over."""
    observation: Observation
    decision: PolicyStep
    result: StepResult


def play_episodes(
    artifact: Artifact,
    env_config: EnvConfig,
    config: SimStudyConfig,
    make_policy: Callable[[int, int], Policy] | None = None,
    purpose: int = STUDIES,
) -> Iterator[PlayedStep]:
    """Play the scenarios of ``config`` in the scenes of ``env_config``, in groups of `_ENVS`.

    Args:
        make_policy: number of robots, seed -> policy; None: that of the artifact.
        purpose: number that `egovcp.sim.scenario` adds to seeds of this purpose.
    """
    scenarios = [Scenario(config.task, purpose + config.seed, i) for i in range(config.episodes)]
    with tqdm(total=len(scenarios), unit="ep", desc=f"play {config.task}") as bar:
        for group in batched(scenarios, _ENVS):
            with closing(VectorEnv(env_config, len(group))) as env:
                policy = (make_policy or artifact.make_policy)(len(group), config.seed)
                observation = env.reset(group)
                while not env.done.all():
                    decision = policy.act(observation.depth, observation.state)
                    live = [int(row) for row in np.flatnonzero(~env.done)]
                    carry, tick = policy.carry.map(torch.clone), np.array(env.tick)
                    before = (env.privileged_state(), carry, tick, env.sent_action)
                    result = env.step(decision.action)
                    policy.advance(result.sent_action)
                    yield PlayedStep(group, env, *before, live, observation, decision, result)
                    observation = result.observation
            bar.update(len(group))
