"""Cells of a grid: shared where they can be, with flags that their commands take."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from egovcp.artifact import save_artifact
from egovcp.cli import parse_config
from egovcp.errors import UsageError
from egovcp.plan import PlannerConfig
from egovcp.testing import toy_model
from egovcp_experiment.cell import Cell, Flags, Found, Given, Output, filled, in_order, written
from egovcp_experiment.config import DataConfig, ExperimentConfig, PlayConfig, TrainingConfig
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.grid import ALL, Grid, Model, Variant
from egovcp_experiment.scales import SCALES
from egovcp_experiment.tools import ARTIFACT, COLLECT, PLAY, TRAIN

CONFIGS = {
    "egovcp_collect.collect": ("egovcp_collect.config", "CollectConfig"),
    "egovcp_train.train": ("egovcp_train.config", "TrainConfig"),
    "egovcp_train.ppo.train": ("egovcp_train.ppo.config", "PpoTrainConfig"),
    "egovcp_deploy.evaluate": ("egovcp_deploy.evaluate", "EvalConfig"),
}


def names(cells: Iterable[Cell]) -> list[str]:
    return [cell.name for cell in cells]


def test_variants_share_data_and_models() -> None:
    grid = Grid(ExperimentConfig(train=TrainingConfig(seeds=(0, 1))))
    for seed in (0, 1):
        grid.play("ball", seed, Variant("plain"))
        grid.play("ball", seed, Variant("long", play={"planner.horizon": 6}))
        grid.play("ball", seed, Variant("other", Model("other", {"policy.hidden": 64})))
    tools = [cell.tool for cell in grid.cells]
    assert (tools.count(COLLECT), tools.count(TRAIN), tools.count(PLAY)) == (1, 4, 6)
    assert in_order(grid.cells) == tuple(grid.cells)


def test_what_differs_in_nothing_is_played_once_for_all_experiments() -> None:
    config = ExperimentConfig(tasks=("ball", "wall"))
    found = {name: {c.name: c for c in e.cells(config)} for name, e in EXPERIMENTS.items()}
    for name in ("generalise", "multitask", "planners", "ppo", "sample-efficiency"):
        for task in ("ball", "wall"):
            play = f"play-{task}-default-s0"
            assert found[name][play].flags == found["ppo"][play].flags
    mixed = found["multitask"]["play-ball-mixed-s0"].flags["policy.path"]
    assert mixed == Output("train-all-default-s0", ARTIFACT)


def test_a_variant_that_asks_for_what_is_done_anyway_is_the_default() -> None:
    play = PlayConfig(task_flags={"ball": ("--planner.action_parameterization=target",)})
    grid = Grid(ExperimentConfig(play=play))
    target, walk = (
        Variant(p, play={"planner.action_parameterization": p}) for p in ("target", "random_walk")
    )
    assert grid.play("ball", 0, target) == grid.play("ball", 0, Variant("default"))
    assert grid.play("ball", 0, walk).name == "play-ball-random_walk-s0"
    assert grid.play("wall", 0, target).name == "play-wall-target-s0"


def test_a_variant_with_the_planner_that_is_trained_for_is_the_default() -> None:
    training = TrainingConfig(
        flags=("--planner.action_parameterization=target",),
        task_flags={"wall": ("--planner.action_parameterization=random_walk",)},
    )
    grid = Grid(ExperimentConfig(train=training))
    ramp = Variant("ramp", play={"planner.action_parameterization": "target"})
    assert grid.play("ball", 0, ramp) == grid.play("ball", 0, Variant("default"))
    assert grid.play("wall", 0, ramp).name == "play-wall-ramp-s0"


@pytest.mark.parametrize(
    ("asked", "known"),
    [
        ({"planner.horizon": 5}, True),
        ({"planner.horizon": 4}, False),
        ({"planner.termination_rule": "shift"}, True),
    ],
)
def test_what_a_model_that_is_there_does_by_itself_is_the_default(
    tmp_path: Path, asked: Flags, known: bool
) -> None:
    planner = PlannerConfig(horizon=5)
    save_artifact(tmp_path / "p", toy_model(), planner, {"controller_id": "stance"})
    grid = Grid(ExperimentConfig(train=TrainingConfig(policies={"ball": str(tmp_path / "p")})))
    variant = Variant("asked", play=asked)
    assert grid.play("ball", 0, variant).name == f"play-ball-{'default' if known else 'asked'}-s0"
    other = grid.play("wall", 0, variant)  # of a model that is still to be trained
    assert (other.name, other.flags | asked) == ("play-wall-asked-s0", other.flags)


def test_what_is_there_already_is_not_made_again() -> None:
    data = DataConfig(roots={"ball": "data/ball"})
    grid = Grid(ExperimentConfig(data=data, train=TrainingConfig(policies={"wall": "a/wall"})))
    grid.play("ball", 0, Variant("plain"))
    grid.play("wall", 0, Variant("plain"))
    assert names(grid.cells) == [
        "train-ball-default-s0",
        "play-ball-default-s0",
        "play-wall-default-s0",
    ]
    assert grid.cells[0].flags["dataset.root"] == Given("data/ball")
    assert grid.cells[2].flags["policy.path"] == Given("a/wall")


def test_a_model_of_all_tasks_reads_all_of_their_data() -> None:
    grid = Grid(ExperimentConfig())
    grid.play("ball", 0, Variant("mixed"), learned_from=ALL)
    train = next(cell for cell in grid.cells if cell.tool is TRAIN)
    names = ("collect-ball-1334", "collect-wall-1334", "collect-arch-870")
    assert train.flags["datasets"] == [{"root": Output(name)} for name in names]


def test_a_task_has_the_last_word_on_how_its_models_are_trained() -> None:
    flags = {"arch": ("--returns.steps=50",), ALL: ("--returns.steps=30",)}
    training = TrainingConfig(flags=("--returns.steps=20", "--threads=1"), task_flags=flags)
    grid = Grid(ExperimentConfig(train=training))
    for learned_from in ("ball", "arch", ALL):
        grid.play("arch", 0, Variant("plain"), learned_from=learned_from)
    trained = [cell.flags for cell in grid.cells if cell.tool is TRAIN]
    assert [f["returns.steps"] for f in trained] == ["20", "50", "30"]
    assert {f["threads"] for f in trained} == {"1"}


def test_a_task_has_the_last_word_on_how_its_models_play() -> None:
    flags = {"arch": ("--planner.elites=8",), ALL: ("--planner.elites=16",)}
    play = PlayConfig(flags=("--planner.elites=4", "--planner.samples=64"), task_flags=flags)
    grid = Grid(ExperimentConfig(play=play))
    played = [
        grid.play("arch", 0, Variant("plain"), learned_from=learned_from).flags
        for learned_from in ("ball", "arch", ALL)
    ]
    assert [f["planner.elites"] for f in played] == ["4", "8", "16"]
    assert {f["planner.samples"] for f in played} == {"64"}
    assert [grid.planner(t)["planner.elites"] for t in ("ball", "arch", ALL)] == ["4", "8", "16"]
    assert grid.references("arch").flags["planner.elites"] == "4"
    varied = Variant("varied", play={"planner.elites": 2})
    assert grid.play("arch", 0, varied).flags["planner.elites"] == 2


@pytest.mark.parametrize("name", ["interpret", "multitask", "planners", "variance"])
def test_studies_plan_as_egovcp_eval_does(name: str) -> None:
    config = replace(
        ExperimentConfig(), play=PlayConfig(flags=("--planner.samples=256", "--num_workers=1"))
    )
    studies = [cell for cell in EXPERIMENTS[name].cells(config) if ".studies." in cell.tool.module]
    assert studies
    for cell in studies:
        assert cell.flags["planner.samples"] == "256"
        assert "num_workers" not in cell.flags


def test_searches_are_timed_alone() -> None:
    cells = EXPERIMENTS["planners"].cells(ExperimentConfig())
    assert {c.name for c in cells if c.tool.alone} == {
        f"plan_time-{task}" for task in ("ball", "wall", "arch")
    }


def test_unknown_variants_and_tasks_are_named() -> None:
    with pytest.raises(UsageError, match="did you mean 'default'"):
        replace(ExperimentConfig(), only=("defualt",)).chosen({"default": 1})
    with pytest.raises(UsageError, match="did you mean 'ball'"):
        ExperimentConfig(output_dir="x", tasks=("bal",)).check()
    with pytest.raises(UsageError, match=r"--train\.task_flags; did you mean 'wall'"):
        ExperimentConfig("x", train=TrainingConfig(task_flags={"wal": ()})).check()
    with pytest.raises(UsageError, match=r"--play\.task_flags; did you mean 'wall'"):
        ExperimentConfig("x", play=PlayConfig(task_flags={"wal": ()})).check()


def test_every_cell_has_flags_that_its_command_takes() -> None:
    """Each distinct value of each flag is parsed once, several flags at a time; of a training all
    together, for its options depend on each other."""
    values: dict[str, dict[str, list[str]]] = {}
    trainings: dict[frozenset[str], list[str]] = {}
    tools: dict[str, Cell] = {}
    for make, experiment in product(SCALES.values(), EXPERIMENTS.values()):
        for cell in in_order(experiment.cells(make())):
            tools[cell.tool.module] = cell
            argv = [*written(filled(cell.flags, _any)), *cell.extra]
            if cell.tool is TRAIN:
                chosen = frozenset(a for a in argv if not a.startswith(("--seed", "--dataset")))
                trainings[chosen] = argv
                continue
            for name, _, value in (arg.partition("=") for arg in argv):
                known = values.setdefault(cell.tool.module, {}).setdefault(name, [])
                if value not in known:
                    known.append(value)
    for module, flags in values.items():
        for k in range(max(map(len, flags.values()))):
            argv = [f"{name}={known[k]}" for name, known in flags.items() if k < len(known)]
            output = f"--{tools[module].tool.output}=x"
            parse_config(_config(tools[module]), [output, *argv], "cell")
    train = tools[TRAIN.module]
    for argv in trainings.values():
        parse_config(_config(train), ["--output_dir=x", *argv], "train", "", _option_defaults())


def _any(reference: Output | Found | Given) -> object:
    """What a reference may stand for."""
    if not isinstance(reference, Found):
        return "folder"
    values: Mapping[str, object] = {"optimiser": "cem"}
    return values.get(reference.keys[-1], 1)


def _config(cell: Cell) -> type[Any]:
    module, name = CONFIGS.get(cell.tool.module, (cell.tool.module, "CONFIG"))
    found: type[Any] = getattr(importlib.import_module(module), name)
    return found


def _option_defaults() -> Any:
    return importlib.import_module("egovcp_train.train").option_defaults


def test_parts_are_prefixes_of_one_dataset_as_large_as_the_largest() -> None:
    data = DataConfig(parts=(0.5, 2.0))
    config = ExperimentConfig(tasks=("ball",), data=data)
    cells = {c.name: c for c in EXPERIMENTS["sample-efficiency"].cells(config)}
    assert cells["collect-ball-2668"].flags["episodes"] == 2668
    parts = [c.flags["dataset.episodes"] for c in cells.values() if c.tool is TRAIN]
    assert parts == ["0:667", "0:2668"]


def test_a_model_that_is_given_does_not_stand_for_one_of_all_episodes() -> None:
    training = TrainingConfig(policies={"ball": "a/ball"})
    config = ExperimentConfig(tasks=("ball", "wall"), data=DataConfig(parts=(1.0,)), train=training)
    cells = EXPERIMENTS["sample-efficiency"].cells(config)
    trained = [cell.name for cell in cells if cell.tool is TRAIN]
    assert trained == ["train-ball-first_1334-s0", "train-wall-default-s0"]
