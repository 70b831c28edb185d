"""Options of `egovcp-experiment`, and the complete configurations that `--scale` selects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

from egovcp.bounds import MAX_PER_CORE, bounded
from egovcp.errors import UsageError, suggest
from egovcp.flags import OTHER_NAMES

#: The paper's tasks.
TASKS: Final = ("ball", "wall", "arch")
#: So that `table1` can compare the objectives of the planner with one model.
_REWARD_HEAD: Final = "--policy.loss.reward=1"
#: So that all trainings draw the same windows: auto depends on the free memory, and stream draws
#: others.
_IN_MEMORY: Final = "--loading.mode=ram"
#: Option of `ExperimentConfig.command_flags` -> flags or groups of flags that cells set -> the
#: option to give instead, if any.
_SET_BY_CELLS: Final[Mapping[str, Mapping[str, str]]] = {
    "scenes": {"task": "tasks"},
    "data.flags": {
        "task": "tasks",
        "episodes": "data.episodes",
        "seed": "data.seed",
        "dataset": "output_dir",
        "resume": "",
    },
    "train.flags": {
        "preset": "train.preset",
        "steps": "train.steps",
        "max_minutes": "train.steps",
        "seed": "train.seeds",
        "dataset": "data.roots",
        "datasets": "data.roots",
        "output_dir": "output_dir",
        "resume": "",
    },
    "play.flags": {
        "task": "tasks",
        "episodes": "play.episodes",
        "seed": "play.seed",
        "controllers": "",
        "policy": "train.policies",
        "ppo": "",
        "output_dir": "output_dir",
    },
    "ppo.flags": {
        "task": "tasks",
        "steps": "ppo.steps",
        "max_minutes": "ppo.steps",
        "save_freq": "ppo.policies",
        "robots": "ppo.robots",
        "ppo.num_steps_per_env": "ppo.ticks",
        "seed": "train.seeds",
        "output_dir": "output_dir",
        "resume": "",
    },
}


@dataclass(frozen=True)
class EpisodesConfig:
    """Number of episodes per task."""

    ball: int = bounded(5400, least=1, most=1_000_000)
    """Episodes of the ball task, by default of 60 ticks each."""
    wall: int = bounded(4000, least=1, most=1_000_000)
    """Episodes of the wall task, by default of 100 ticks each."""
    arch: int = bounded(870, least=1, most=1_000_000)
    """Episodes of the arch task, by default of 230 ticks each."""


@dataclass(frozen=True)
class DataConfig:
    """Random data that models are trained on."""

    episodes: EpisodesConfig = field(default_factory=EpisodesConfig)
    """Episodes to collect."""
    seed: int = bounded(0, least=0)
    """Seed of the collection."""
    parts: tuple[float, ...] = bounded((0.125, 0.25, 0.5, 1.0), above=0)
    """Shares of the episodes that sample-efficiency trains on; above 1, more episodes are collected
    for it."""
    roots: dict[str, str] = field(default_factory=dict)
    """Existing datasets per task, '{ball: data/ball}', instead of collecting."""
    flags: tuple[str, ...] = ()
    """Further flags of egovcp-collect, '[--num_envs=8]'."""


@dataclass(frozen=True)
class TrainingConfig:
    """Training of the world models."""

    preset: Literal["default", "paper", "debug"] = "default"
    """Preset of egovcp-train."""
    steps: int = bounded(3000, least=1)
    """Gradient steps of a model."""
    seeds: tuple[int, ...] = bounded((), least=0)
    """Training seeds; every model is trained once with each. Empty: 0, 1 and 2 for table1 and
    sample-efficiency, 0 for the other experiments."""
    policies: dict[str, str] = field(default_factory=dict)
    """Existing policies instead of training the default model, '{all: contact}'; `all` is the model
    of all --tasks, a task that of this task alone. Used for every seed."""
    flags: tuple[str, ...] = (
        "--eval_freq=0",
        "--tensorboard=false",
        _IN_MEMORY,
        _REWARD_HEAD,
    )
    """Further flags of egovcp-train."""


@dataclass(frozen=True)
class PlayConfig:
    """Closed-loop episodes."""

    episodes: int = bounded(100, least=1, most=1_000_000)
    """Scenarios of each task; all variants play the same ones."""
    seed: int = bounded(20, least=0)  # options were tuned on the scenarios of seeds 0 to 9
    """Seed of the held-out scenarios."""
    branches: int = bounded(6, least=2, most=10_000)
    """Random-walk rollouts from each plan step; their mean return is what Q is compared with
    (experiment `variance`)."""
    budget_ms: float = bounded(12.0, above=0)  # fits 64 candidates on one core without AVX-512
    """Time budget per plan in the experiment `planners`, ms."""
    flags: tuple[str, ...] = ()
    """Further flags of egovcp-eval; studies in simulation use those of the planner."""


@dataclass(frozen=True)
class PpoBaselineConfig:
    """The model-free baseline of ppo and sample-efficiency."""

    steps: int = bounded(500_000, least=0)
    """Transitions of a training, rounded to whole updates between policies; 0: no PPO in
    sample-efficiency."""
    policies: int = bounded(4, least=1, most=10_000)
    """Policies that are evaluated, at equal distances along a training, the last at its end."""
    robots: int = bounded(32, least=1, most=65_536)
    """Robots simulated in parallel."""
    ticks: int = bounded(50, least=1, most=100_000)
    """Ticks of each robot between two updates."""
    flags: tuple[str, ...] = ()
    """Further flags of egovcp-train-ppo, '[--ppo.entropy_coef=0.01]'."""

    @property
    def updates(self) -> int:
        """Updates between two policies."""
        return max(1, round(self.steps / (self.policies * self.robots * self.ticks)))

    @property
    def transitions(self) -> tuple[int, ...]:
        """Transitions seen by each of the policies."""
        if not self.steps:
            return ()
        each = self.updates * self.robots * self.ticks
        return tuple(each * (k + 1) for k in range(self.policies))


@dataclass(frozen=True)
class ExperimentConfig:
    """Run one of the paper's experiments, cell by cell, and write its report.

    Complete cells are not run again: the same command continues where it was stopped, and
    experiments with the same output folder share datasets and models. --scale sets the defaults of
    all other options.
    """

    output_dir: str = ""
    """Folder of cells and reports; experiments with the same options can share it."""
    scale: Literal["smoke", "small", "paper"] = "small"
    """smoke: minutes, metrics without meaning; small: hours on two cores; paper: the paper's."""
    jobs: int = bounded(1, least=1, per_core=MAX_PER_CORE)
    """Cells that run at the same time, each on its share of the CPU cores."""
    tasks: tuple[str, ...] = TASKS
    """Tasks to learn and play."""
    only: tuple[str, ...] = ()
    """Names of the variants to run, if the experiment has variants; empty: all."""
    most: int = bounded(0, least=0)
    """Run only the first variants, at most this many; 0: all."""
    scenes: tuple[str, ...] = ()
    """Scene flags of both collection and evaluation, '[--env.ball.shape=box]'."""
    data: DataConfig = field(default_factory=DataConfig)
    """Data."""
    train: TrainingConfig = field(default_factory=TrainingConfig)
    """Training."""
    ppo: PpoBaselineConfig = field(default_factory=PpoBaselineConfig)
    """The model-free baseline."""
    play: PlayConfig = field(default_factory=PlayConfig)
    """Closed loop."""

    def check(self) -> None:
        """Raise `UsageError` for invalid values."""
        if not self.output_dir:
            raise UsageError("--output_dir is missing; name the folder of cells and reports")
        for option, given, known in (
            ("tasks", self.tasks, TASKS),
            ("data.roots", self.data.roots, TASKS),
            ("train.policies", self.train.policies, (*TASKS, "all")),
        ):
            for task in given:
                if task not in known:
                    raise UsageError(f"unknown task {task} in --{option}{suggest(task, known)}")
        for option, listed in (
            ("tasks", self.tasks),
            ("train.seeds", self.train.seeds),
            ("data.parts", self.data.parts),
        ):
            empty = not listed and option != "train.seeds"
            if empty or len(set(listed)) < len(listed):
                raise UsageError(
                    f"--{option}=[{', '.join(map(str, listed))}]: expected at least one, and none "
                    "twice"
                )
        for flag in self.scenes:
            if not flag.startswith("--env."):
                raise UsageError(f"--scenes holds {flag}; expected --env.NAME=value")
        for option, flags in self.command_flags.items():
            _refuse_flags_of_cells(option, flags)

    @property
    def command_flags(self) -> dict[str, tuple[str, ...]]:
        """Option -> its flags for the commands of cells."""
        return {
            "scenes": self.scenes,
            "data.flags": self.data.flags,
            "train.flags": self.train.flags,
            "play.flags": self.play.flags,
            "ppo.flags": self.ppo.flags,
        }

    def chosen[T](self, variants: dict[str, T]) -> dict[str, T]:
        """The variants that `only` names, or the first `most`.

        Raises:
            UsageError: a name is unknown.
        """
        for name in self.only:
            if name not in variants:
                raise UsageError(f"unknown variant --only={name}{suggest(name, variants)}")
        names = self.only or tuple(variants)[: self.most or None]
        return {name: variants[name] for name in variants if name in names}


def _refuse_flags_of_cells(option: str, flags: Sequence[str]) -> None:
    """Raise `UsageError` for flags that cells set."""
    for flag in flags:
        name = flag.removeprefix("--").split("=", 1)[0]
        name = OTHER_NAMES.get(name, name)
        for own, instead in _SET_BY_CELLS[option].items():
            if f"{name}.".startswith(f"{own}.") or own.startswith(f"{name}."):
                hint = f"give --{instead}" if instead else "leave it out"
                raise UsageError(f"--{option} holds {flag}, which the experiment sets; {hint}")


def smoke() -> ExperimentConfig:
    """Every command of an experiment once, in minutes; the metrics mean nothing."""
    return ExperimentConfig(
        scale="smoke",
        most=3,
        scenes=(  # episodes of 1 to 2 s
            "--env.ball_episode.ticks=30",
            "--env.ball_episode.event_ticks=[2,4]",
            "--env.wall_episode.ticks=30",
            "--env.wall_episode.event_ticks=[2,4]",
            "--env.arch_episode.ticks=50",
            "--env.arch_episode.event_ticks=[2,4]",
        ),
        data=DataConfig(EpisodesConfig(ball=24, wall=24, arch=24), parts=(0.5, 1.0)),
        train=TrainingConfig(
            preset="debug",
            steps=4,
            seeds=(0,),
            flags=(
                "--batch_size=4",
                "--sampling.length=9",
                "--returns.steps=6",
                "--planner.samples=32",
                "--planner.elites=8",
                "--tensorboard=false",
                "--device=cpu",
                "--threads=1",
                "--save_freq=2",
                _REWARD_HEAD,
            ),
        ),
        ppo=PpoBaselineConfig(
            steps=64,
            policies=2,
            robots=4,
            ticks=8,
            flags=("--ppo.num_mini_batches=2", "--tensorboard=false", "--threads=1"),
        ),
        play=PlayConfig(
            episodes=4, seed=0, branches=2, budget_ms=5.0, flags=("--num_workers=1", "--num_envs=4")
        ),
    )


def small() -> ExperimentConfig:
    """Hours on two cores: 200 000 to 400 000 random steps per task, 3000 gradient steps per model,
    100 paired episodes."""
    return ExperimentConfig()


def paper() -> ExperimentConfig:
    """The paper's scale, for a GPU: 500 000 random steps per task, three training seeds."""
    return ExperimentConfig(
        scale="paper",
        data=DataConfig(
            EpisodesConfig(ball=8334, wall=5000, arch=2174), parts=(0.1, 0.2, 0.5, 1.0, 2.0)
        ),
        train=TrainingConfig(
            steps=100_000,
            seeds=(0, 1, 2),
            flags=("--eval_freq=0", _IN_MEMORY, _REWARD_HEAD),
        ),
        ppo=PpoBaselineConfig(steps=5_000_000, policies=10),
        play=PlayConfig(episodes=300, branches=12, budget_ms=40.0),
    )


SCALES: Final[Mapping[str, Callable[[], ExperimentConfig]]] = {
    "smoke": smoke,
    "small": small,
    "paper": paper,
}
