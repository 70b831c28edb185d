"""The options of `egovcp-experiment`: what a scale stands for, and what flags may change."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from egovcp.bounds import bounded, check_bounds, require_cores
from egovcp.errors import UsageError, suggest
from egovcp.spec import TASKS

Scale = Literal["smoke", "small", "paper"]


@dataclass(frozen=True)
class EpisodesConfig:
    """A number of episodes for each task."""

    ball: int = bounded(1334, least=1, most=1_000_000)
    """Of the ball task, 150 ticks each where no flag says otherwise."""
    wall: int = bounded(1334, least=1, most=1_000_000)
    """Of the wall task, likewise."""
    arch: int = bounded(870, least=1, most=1_000_000)
    """Of the arch task, 230 ticks each."""


@dataclass(frozen=True)
class DataConfig:
    """The random data that models are trained on."""

    episodes: EpisodesConfig = field(default_factory=EpisodesConfig)
    """Episodes to collect."""
    seed: int = bounded(0, least=0)
    """Seed of the collection."""
    parts: tuple[float, ...] = bounded((0.125, 0.25, 0.5, 1.0), above=0)
    """Shares of the episodes that models are trained on in sample-efficiency, ascending; above 1,
    more are collected for it."""
    roots: dict[str, str] = field(default_factory=dict)
    """Datasets that are there already, '{ball: data/ball}'; they are not collected again."""
    flags: tuple[str, ...] = ()
    """Further flags of egovcp-collect, '[--num_envs=8]'."""


@dataclass(frozen=True)
class TrainingConfig:
    """How models are trained."""

    preset: Literal["default", "paper", "debug"] = "default"
    """Starting point of all options of egovcp-train."""
    steps: int = bounded(20_000, least=1)
    """Gradient steps of a model."""
    max_minutes: float = bounded(0.0, least=0)
    """Wall-clock limit of a training, minutes; 0: none."""
    compared_steps: int = bounded(20_000, least=1)
    """Gradient steps, without a limit of time, where choices of training are compared."""
    seeds: tuple[int, ...] = bounded((0,), least=0)
    """Every model is trained once with each of these."""
    policies: dict[str, str] = field(default_factory=dict)
    """Artifacts that are there already, '{ball: RUN/checkpoints/last/pretrained_model}', in the
    place of the default model of that task (all: of the multi-task model) under every seed."""
    flags: tuple[str, ...] = ()
    """Further flags of egovcp-train."""
    task_flags: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Flags after those for the models of one task (all: of the multi-task model), '{wall:
    [--batch_size=32]}'."""

    @property
    def budget(self) -> str:
        """For how long a model is trained, in words."""
        if self.max_minutes:
            return f"{self.max_minutes:g} minutes"
        return f"{self.steps} gradient steps"


@dataclass(frozen=True)
class PlayConfig:
    """The closed-loop episodes."""

    episodes: int = bounded(100, least=1, most=1_000_000)
    """Scenarios of each task; all variants play the same."""
    seed: int = bounded(0, least=0)
    """Which held-out scenarios."""
    branches: int = bounded(12, least=2, most=10_000)
    """Random walks from each step of a plan, whose mean return is what the step is worth."""
    budget_ms: float = bounded(40.0, above=0)
    """Time for a plan, where searches are compared on equal time, ms."""
    flags: tuple[str, ...] = ()
    """Further flags of egovcp-eval; studies that play take those of the planner, too."""
    task_flags: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Flags after those where the model of one task plays (all: the multi-task model), '{ball:
    [--planner.action_parameterization=target]}'."""


@dataclass(frozen=True)
class PpoConfig:
    """The model-free baseline, in ppo and sample-efficiency."""

    steps: int = bounded(200_000, least=0)
    """Transitions of a training, rounded to whole updates between policies; 0: no PPO in
    sample-efficiency."""
    policies: int = bounded(4, least=1, most=10_000)
    """Policies along a training that are played, equally far apart; the last is that of its
    end."""
    robots: int = bounded(32, least=1, most=65_536)
    """Robots simulated side by side."""
    ticks: int = bounded(50, least=1, most=100_000)
    """Ticks of each robot from one update to the next."""
    flags: tuple[str, ...] = ()
    """Further flags of egovcp-train-ppo, '[--ppo.entropy_coef=0.01]'."""

    @property
    def updates(self) -> int:
        """Updates from one policy to the next."""
        return max(1, round(self.steps / (self.policies * self.robots * self.ticks)))

    @property
    def transitions(self) -> tuple[int, ...]:
        """What each of the policies has seen."""
        if not self.steps:
            return ()
        each = self.updates * self.robots * self.ticks
        return tuple(each * (k + 1) for k in range(self.policies))

    def check(self) -> None:
        """Raise `UsageError` for values that make no sense."""
        own = ("steps", "robots", "ppo.num_steps_per_env", "save_freq", "max_minutes")
        for flag in self.flags:
            if flag.removeprefix("--").split("=", 1)[0] in own:
                raise UsageError(
                    f"--ppo.flags holds {flag}, which decides what policies there are; say it with "
                    "--ppo.steps, --ppo.policies, --ppo.robots and --ppo.ticks"
                )


@dataclass(frozen=True)
class RayConfig:
    """What a cell is given on a Ray cluster."""

    cpus: float = bounded(1.0, above=0)
    """Processor cores that are set aside for it. Commands see all cores of their node none the
    less: tell `egovcp-collect --num_workers` and `egovcp-train --threads` with
    '--data.flags=[--num_workers=8]', '--train.flags=[--threads=8]'."""
    gpus: float = bounded(0.0, least=0)
    """GPUs that are set aside for a training; other cells get none."""


@dataclass(frozen=True)
class ExperimentConfig:
    """Run one of the paper's experiments, cell by cell, and write its report.

    A cell that is complete is never run again: the same command goes on where it was stopped, and
    experiments with the same output folder share datasets and models. --scale says what all other
    options are, unless they are given.
    """

    output_dir: str = ""
    """Folder of cells and reports; may hold those of other experiments of the same options."""
    scale: Scale = "small"
    """smoke: minutes, the figures mean nothing; small: hours on two cores; paper: the paper's."""
    backend: Literal["local", "ray"] = "local"
    """Where cells run: processes of this machine; or the Ray cluster of RAY_ADDRESS, all of whose
    nodes must have --output_dir under the same path."""
    jobs: int = bounded(1, least=1, most=1024)
    """Cells that run side by side; here each on its share of the processor cores."""
    ray: RayConfig = field(default_factory=RayConfig)
    """Each cell's share of a Ray cluster."""
    tasks: tuple[str, ...] = TASKS
    """Tasks to learn and play."""
    only: tuple[str, ...] = ()
    """Names of the variants to run; empty: all."""
    most: int = bounded(0, least=0)
    """Of all, only so many variants; 0: no limit."""
    scenes: tuple[str, ...] = ()
    """Flags of both collection and play, as of `egovcp-collect --env.*`:
    '[--env.controller=stance]'."""
    data: DataConfig = field(default_factory=DataConfig)
    """Data."""
    train: TrainingConfig = field(default_factory=TrainingConfig)
    """Training."""
    ppo: PpoConfig = field(default_factory=PpoConfig)
    """The model-free baseline."""
    play: PlayConfig = field(default_factory=PlayConfig)
    """Closed loop."""

    def check(self) -> None:
        """Raise `UsageError` for values that make no sense."""
        if not self.output_dir:
            raise UsageError("--output_dir is missing; name the folder of cells and reports")
        check_bounds(self, "--")
        if self.backend == "local":
            require_cores("--jobs", self.jobs)
        models = (*TASKS, "all")
        for option, given, known in (
            ("tasks", self.tasks, TASKS),
            ("data.roots", self.data.roots, TASKS),
            ("train.policies", self.train.policies, models),
            ("train.task_flags", self.train.task_flags, models),
            ("play.task_flags", self.play.task_flags, models),
        ):
            for task in given:
                if task not in known:
                    raise UsageError(f"unknown task {task} in --{option}{suggest(task, known)}")
        for option, listed in (
            ("tasks", self.tasks),
            ("train.seeds", self.train.seeds),
            ("data.parts", self.data.parts),
        ):
            if not listed or len(set(listed)) < len(listed):
                raise UsageError(
                    f"--{option}=[{', '.join(map(str, listed))}]: expected at least one, and none "
                    "twice"
                )
        for flag in self.scenes:
            if not flag.startswith("--env."):
                raise UsageError(f"--scenes holds {flag}; expected --env.NAME=value")
        self.ppo.check()

    def chosen[T](self, variants: dict[str, T]) -> dict[str, T]:
        """Those of the variants that `only` names, or the first `most`.

        Raises:
            UsageError: one of the names is unknown.
        """
        for name in self.only:
            if name not in variants:
                raise UsageError(f"unknown variant --only={name}{suggest(name, variants)}")
        names = self.only or tuple(variants)[: self.most or None]
        return {name: variants[name] for name in variants if name in names}
