"""Cells of a grid: shared where they can be, with flags that their commands take."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import pytest

from egovcp.cli import parse_config
from egovcp.errors import UsageError
from egovcp_experiment.cell import Cell, Found, Given, Output, filled, in_order, written
from egovcp_experiment.config import DataConfig, ExperimentConfig, TrainingConfig
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.grid import ALL, Grid, Model, Variant
from egovcp_experiment.scales import SCALES
from egovcp_experiment.tools import COLLECT, PLAY, TRAIN

CONFIGS = {
    "egovcp_collect.collect": ("egovcp_collect.config", "CollectConfig"),
    "egovcp_train.train": ("egovcp_train.config", "TrainConfig"),
    "egovcp_deploy.evaluate": ("egovcp_deploy.evaluate", "EvalConfig"),
}


def names(cells: Iterable[Cell]) -> list[str]:
    return [cell.name for cell in cells]


def test_variants_share_data_and_models() -> None:
    grid = Grid(ExperimentConfig(train=TrainingConfig(seeds=(0, 1))))
    for seed in (0, 1):
        grid.play("ball", seed, Variant("plain"))
        grid.play("ball", seed, Variant("long", play={"planner.horizon": 6}))
        grid.play("ball", seed, Variant("other", Model("other", {"policy.q_heads": 5})))
    tools = [cell.tool for cell in grid.cells]
    assert (tools.count(COLLECT), tools.count(TRAIN), tools.count(PLAY)) == (1, 4, 6)
    assert in_order(grid.cells) == tuple(grid.cells)


def test_what_is_there_already_is_not_made_again() -> None:
    data = DataConfig(roots={"ball": "data/ball"})
    grid = Grid(ExperimentConfig(data=data, train=TrainingConfig(policies={"wall": "a/wall"})))
    grid.play("ball", 0, Variant("plain"))
    grid.play("wall", 0, Variant("plain"))
    assert names(grid.cells) == [
        "train-ball-default-s0",
        "play-ball-plain-s0",
        "play-wall-plain-s0",
    ]
    assert grid.cells[0].flags["dataset.root"] == Given("data/ball")
    assert grid.cells[2].flags["policy.path"] == Given("a/wall")


def test_a_model_of_all_tasks_reads_all_of_their_data() -> None:
    grid = Grid(ExperimentConfig())
    grid.play("ball", 0, Variant("mixed"), learned_from=ALL)
    train = next(cell for cell in grid.cells if cell.tool is TRAIN)
    assert train.flags["datasets"] == [
        {"root": Output(f"collect-{task}")} for task in ("ball", "wall", "arch")
    ]


def test_unknown_variants_and_tasks_are_named() -> None:
    with pytest.raises(UsageError, match="did you mean 'default'"):
        replace(ExperimentConfig(), only=("defualt",)).chosen({"default": 1})
    with pytest.raises(UsageError, match="did you mean 'ball'"):
        ExperimentConfig(output_dir="x", tasks=("bal",)).check()


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_cell_has_flags_that_its_command_takes(name: str, scale: Any) -> None:
    cells = in_order(EXPERIMENTS[name].cells(SCALES[scale]()))
    assert cells
    for cell in cells:
        argv = [f"--{cell.tool.output}=x", *written(filled(cell.flags, _any)), *cell.extra]
        parse_config(_config(cell), argv, "cell", "", _defaults(cell))


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


def _defaults(cell: Cell) -> Any:
    if cell.tool is TRAIN:
        return importlib.import_module("egovcp_train.train").option_defaults
    return None
