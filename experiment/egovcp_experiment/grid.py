"""Cells for training flags x playing flags x tasks x seeds; equal runs are shared.

collect-TASK-COUNT
train-all-MODEL-sSEED      on the data of all tasks; train-TASK-MODEL-sSEED: of one task
play-TASK-VARIANT-sSEED    the planner with that model; `default` without changed flags
bounds-TASK                hold, random and oracle on the same scenarios
references-TASK            the same with constant, which needs an expensive search
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from egovcp.data.schema import INFO_PATH
from egovcp.files import user_path
from egovcp_experiment.cell import (
    ARTIFACT,
    COLLECT,
    PLAY,
    TRAIN,
    Cell,
    CellOutput,
    ExternalPath,
    Flags,
    checkpoint_artifact,
    read_json,
    study,
)
from egovcp_experiment.config import ExperimentConfig

#: Name of the model of several tasks, in place of a task.
ALL: Final = "all"
#: Name of a model or variant without changed flags, which all experiments share.
DEFAULT: Final = "default"
#: Controllers of egovcp-eval that need neither a model nor a search.
REFERENCES: Final = ("hold", "random", "oracle")


@dataclass(frozen=True)
class Model:
    """Training of a world model."""

    name: str = DEFAULT
    """Part of the names of cells."""
    flags: Flags = field(default_factory=dict)
    """Changed flags of egovcp-train."""
    step: int = 0
    """Gradient steps after which it is played; 0: at the end."""
    seeds: int | None = None
    """Number of trainings, with the first seeds; None: all seeds."""


_UNCHANGED: Final[Flags] = {}
_DEFAULT_MODEL: Final = Model()


class Grid:
    """Makes the cells of one configuration; equal requests give equal cells."""

    def __init__(self, config: ExperimentConfig) -> None:
        self.config = config
        self.collected = 1.0
        """Share of the configured episodes to collect."""
        self._cells: dict[str, Cell] = {}

    @property
    def trained_on(self) -> str:
        """What the models of this configuration learn: `ALL`, or the only task."""
        tasks = self.config.tasks
        return ALL if len(tasks) > 1 else tasks[0]

    def given_policy(self, task: str) -> str:
        """The policy of ``--train.policies`` for a task, or `ALL`; empty: none."""
        given = self.config.train.policies
        return given.get(task) or (given.get(ALL, "") if task == self.trained_on else "")

    @property
    def cells(self) -> list[Cell]:
        """All requested cells, each after those it needs."""
        return list(self._cells.values())

    def add(self, cell: Cell) -> Cell:
        """Add a cell; those it needs come before."""
        known = self._cells.setdefault(cell.name, cell)
        assert known == cell, f"two different cells are called {cell.name}"
        return cell

    def episodes(self, task: str, share: float = 1.0) -> int:
        """Number of episodes in a share of the given dataset, or of the configured ones."""
        given = task in self.config.data.roots
        whole = self.given_size(task)[0] if given else getattr(self.config.data.episodes, task)
        return max(1, round(share * whole))

    def given_size(self, task: str) -> tuple[int, int]:
        """Episodes and transitions of the dataset in `DataConfig.roots`."""
        info = read_json(user_path(self.config.data.roots[task]) / INFO_PATH)
        return info["total_episodes"], info["total_frames"]

    def data(self, task: str) -> CellOutput | ExternalPath:
        """Random data of a task."""
        config = self.config.data
        if task in config.roots:
            return ExternalPath(config.roots[task])
        episodes = self.episodes(task, self.collected)
        flags = {"task": task, "episodes": episodes, "seed": config.seed}
        extra = (*self.config.scenes, *config.flags)
        return CellOutput(self.add(Cell(f"collect-{task}-{episodes}", COLLECT, flags, extra)).name)

    def model(
        self, task: str, seed: int, model: Model = _DEFAULT_MODEL
    ) -> CellOutput | ExternalPath:
        """Artifact of a model trained on a task, or on `ALL`."""
        path = self.given_policy(task)
        if path and not model.flags and not model.step:
            return ExternalPath(path)
        artifact = checkpoint_artifact(model.step) if model.step else ARTIFACT
        return CellOutput(self.train(task, seed, model).name, artifact)

    def train(self, task: str, seed: int, model: Model, name: str = "") -> Cell:
        """A training, whose metrics are those on held-out episodes."""
        config = self.config.train
        tasks = self.config.tasks if task == ALL else (task,)
        data: dict[str, Any] = {"dataset.root": self.data(tasks[0])}
        if len(tasks) > 1:
            data = {"datasets": [{"root": self.data(one)} for one in tasks]}
        flags = {**data, "preset": config.preset, "steps": config.steps, "seed": seed}
        flags |= {**parse_flags(config.flags), **model.flags}
        return self.add(Cell(name or f"train-{task}-{model.name}-s{seed}", TRAIN, flags))

    def plays(
        self,
        task: str,
        variant: str = DEFAULT,
        flags: Flags = _UNCHANGED,
        model: Model = _DEFAULT_MODEL,
        trained_on: str = "",
    ) -> list[str]:
        """Names of the cells of the planner in closed loop, one per training.

        Args:
            variant: part of the names, unless no flag is changed.
            flags: changed flags of egovcp-eval.
            trained_on: task of the model; empty: all tasks.
        """
        trained_on = trained_on or self.trained_on
        changed = flags or model.flags or model.step or trained_on != self.trained_on
        names = []
        for seed in self.config.train.seeds[: model.seeds]:
            policy = {"controllers": "planner", "policy.path": self.model(trained_on, seed, model)}
            name = f"play-{task}-{variant if changed else DEFAULT}-s{seed}"
            self.add(Cell(name, PLAY, {**self.scenarios(task), **policy, **flags}))
            names.append(name)
        return names

    def references(
        self,
        task: str,
        name: str = "",
        scene: Flags | None = None,
        controllers: Sequence[str] = REFERENCES,
    ) -> str:
        """Name of the cell of reference controllers, on the planner's scenarios in a changed
        ``scene``."""
        flags = {**self.scenarios(task), "controllers": ",".join(controllers), **(scene or {})}
        return self.add(Cell(name or f"bounds-{task}", PLAY, flags)).name

    def study(
        self,
        name: str,
        task: str,
        flags: Flags,
        extra: Sequence[str] = (),
        exclusive: bool = False,
        model: Model = _DEFAULT_MODEL,
    ) -> str:
        """Name of the cell STUDY-TASK: a study of the first training of a model, with the planner
        flags of egovcp-eval."""
        play = parse_flags(self.config.play.flags)
        planner = {flag: value for flag, value in play.items() if flag.startswith("planner.")}
        policy = self.model(self.trained_on, self.config.train.seeds[0], model)
        cell = name if task == ALL else f"{name}-{task}"
        flags = {**planner, "policy.path": policy, **flags}
        return self.add(Cell(cell, study(name, exclusive), flags, tuple(extra))).name

    def sim_study(self, name: str, task: str, flags: Flags, model: Model = _DEFAULT_MODEL) -> str:
        """Name of the cell of a study in simulation, in the configured scenes."""
        seed = {"seed": self.config.play.seed}
        return self.study(name, task, {**flags, **seed}, self.config.scenes, model=model)

    def scenarios(self, task: str) -> Flags:
        """Flags of egovcp-eval for the scenarios of a task."""
        config = self.config.play
        given = parse_flags((*self.config.scenes, *config.flags))
        return {"task": task, "episodes": config.episodes, "seed": config.seed, **given}


def parse_flags(flags: Sequence[str]) -> dict[str, str]:
    """Name -> value of ``--name=value`` or ``--name`` (true); the last one counts."""
    parts = (flag.removeprefix("--").partition("=") for flag in flags)
    return {name: value if equals else "true" for name, equals, value in parts}
