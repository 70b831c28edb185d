"""A table of training flags x playing flags x tasks x seeds, as cells that share what they can.

collect-TASK-COUNT
train-TASK-MODEL-sSEED     from the data of a task, or under the task `all` from that of all
play-TASK-VARIANT-sSEED    the planner with that model; VARIANT is `default` where nothing differs
references-TASK            hold, constant, random and oracle on the same scenarios
bounds-TASK                the same without constant, whose search costs the most
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from egovcp.artifact import CONFIG, read_options
from egovcp_experiment.cell import Cell, Flags, Given, Output, references, text
from egovcp_experiment.config import ExperimentConfig
from egovcp_experiment.tools import ARTIFACT, COLLECT, PLAY, TRAIN

#: The task of a model that learns all tasks, as egovcp-collect and egovcp-eval call them together.
ALL: Final = "all"
#: A model of a task's own data, trained and used as the configuration says: every experiment needs
#: some, under whatever name it lists them.
DEFAULT: Final = "default"
#: Controllers of egovcp-eval that need no model.
REFERENCES: Final = ("hold", "constant", "random", "oracle")
#: Those of them that need no search either.
BOUNDS: Final = ("hold", "random", "oracle")


@dataclass(frozen=True)
class Model:
    """How a world model is trained."""

    name: str = DEFAULT
    """Part of the names of cells."""
    flags: Flags = field(default_factory=dict)
    """What differs from the default, flags of egovcp-train."""


@dataclass(frozen=True)
class Variant:
    """A model, and how it is used."""

    name: str
    """Part of the names of cells, unless nothing differs from `DEFAULT`."""
    model: Model = field(default_factory=Model)
    """Its training."""
    play: Flags = field(default_factory=dict)
    """What differs in its use, flags of egovcp-eval."""


class Grid:
    """Makes the cells of one configuration; equal requests give equal cells."""

    def __init__(self, config: ExperimentConfig) -> None:
        self.config = config
        self._cells: dict[str, Cell] = {}

    @property
    def cells(self) -> list[Cell]:
        """All that was asked for, every cell after those it needs."""
        return list(self._cells.values())

    def add(self, cell: Cell) -> Cell:
        """Add a cell, after those it needs."""
        self._cells.setdefault(cell.name, cell)
        return cell

    def data(self, task: str) -> Output | Given:
        """The random data of a task."""
        config = self.config.data
        if task in config.roots:
            return Given(config.roots[task])
        episodes = getattr(config.episodes, task)
        flags = {"task": task, "episodes": episodes, "seed": config.seed}
        extra = (*self.config.scenes, *config.flags)
        return Output(self.add(Cell(f"collect-{task}-{episodes}", COLLECT, flags, extra)).name)

    def model(self, task: str, seed: int, model: Model | None = None) -> Output | Given:
        """The artifact of a model that was trained on a task, or on `ALL` of them."""
        model = model or Model()
        config = self.config.train
        if task in config.policies and not model.flags:
            return Given(config.policies[task])
        return Output(self.train(task, seed, model).name, ARTIFACT)

    def train(self, task: str, seed: int, model: Model, name: str = "") -> Cell:
        """The training itself, whose figures are those on held-out episodes."""
        config = self.config.train
        tasks = self.config.tasks if task == ALL else (task,)
        data: dict[str, Any] = {"dataset.root": self.data(tasks[0])}
        if len(tasks) > 1:
            data = {"datasets": [{"root": self.data(one)} for one in tasks]}
        flags = {**data, "preset": config.preset, "steps": config.steps, "seed": seed}
        if config.max_minutes:
            flags["max_minutes"] = config.max_minutes
        cell = Cell(
            name or f"train-{task}-{model.name}-s{seed}",
            TRAIN,
            {**flags, **self._trained_with(task), **model.flags},
        )
        return self.add(cell)

    def _trained_with(self, task: str) -> dict[str, str]:
        """Flags of egovcp-train for the models of ``task``, or `ALL`, by the configuration."""
        config = self.config.train
        return _named((*config.flags, *config.task_flags.get(task, ())))

    def play(self, task: str, seed: int, variant: Variant, learned_from: str = "") -> Cell:
        """The planner in closed loop. A variant that asks for what is done anyway is the default:
        by the flags of egovcp-eval or by the planner options of the model.

        Args:
            task: what is played.
            seed: of the training.
            variant: the model and its use.
            learned_from: the task, or `ALL`, that the model was trained on; empty: the one played.
        """
        teacher = learned_from or task
        policy = self.model(teacher, seed, variant.model)
        own = _named(self.config.play.task_flags.get(teacher, ()))
        flags = {**self.scenarios(task), **own, "controllers": "planner", "policy.path": policy}
        anyway = {**self._planner_of(policy, teacher), **flags}
        changes = {
            name: value
            for name, value in variant.play.items()
            if name not in anyway or _written(anyway[name]) != _written(value)
        }
        differs = changes or variant.model.flags or teacher != task
        name = f"play-{task}-{variant.name if differs else DEFAULT}-s{seed}"
        return self.add(Cell(name, PLAY, {**flags, **changes}))

    def _planner_of(self, policy: Output | Given, task: str) -> Flags:
        """Planner options of a model of ``task``, or `ALL`, that are known before it is trained."""
        if isinstance(policy, Output):
            return _planner_flags(self._trained_with(task))
        if not (Path(policy.path) / CONFIG).is_file():
            return {}
        _, planner = read_options(Path(policy.path))
        return {f"planner.{name}": value for name, value in asdict(planner).items()}

    def references(
        self,
        task: str,
        name: str = "",
        scene: Flags | None = None,
        who: Sequence[str] = REFERENCES,
    ) -> Cell:
        """Who needs no model, on the same scenarios as the planner.

        Args:
            task: what is played.
            name: of the cell; empty: references-TASK.
            scene: --env.* flags that differ from the configuration's.
            who: controllers of egovcp-eval.
        """
        flags = {**self.scenarios(task), "controllers": ",".join(who), **(scene or {})}
        return self.add(Cell(name or f"references-{task}", PLAY, flags))

    def bounds(self, task: str) -> Cell:
        """`BOUNDS` on the same scenarios as the planner."""
        return self.references(task, f"bounds-{task}", who=BOUNDS)

    def planner(self, task: str) -> Flags:
        """Flags that change the planner of the model of ``task``, or `ALL`, for studies that
        play."""
        config = self.config.play
        return _planner_flags(_named((*config.flags, *config.task_flags.get(task, ()))))

    def scenarios(self, task: str) -> Flags:
        """Flags of egovcp-eval that say what is played, by whoever it is."""
        config = self.config.play
        given = _named((*self.config.scenes, *config.flags))
        return {
            "task": task,
            "episodes": config.episodes,
            "seed": config.seed,
            **given,
        }


def _written(value: Any) -> Any:
    """Text of a flag's value, to be compared; what another cell will find is only itself."""
    return value if any(references(value)) else text(value)


def _planner_flags(flags: Flags) -> Flags:
    return {name: value for name, value in flags.items() if name.startswith("planner.")}


def _named(flags: Sequence[str]) -> dict[str, str]:
    """Name -> value of flags as they are written, ``--name=value``; of several the last."""
    return dict(flag.removeprefix("--").split("=", 1) for flag in flags)
