"""Cells of a grid: shared where they can be, with flags that their commands take."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, get_type_hints

import pytest

from egovcp.cli import parse_config, preset_defaults
from egovcp.files import write_json
from egovcp_collect.config import PRESETS, CollectConfig
from egovcp_experiment.cell import (
    ARTIFACT,
    COLLECT,
    PLAY,
    TRAIN,
    Cell,
    CellMetric,
    CellOutput,
    ExternalPath,
    resolve,
    to_argv,
)
from egovcp_experiment.config import (
    SCALES,
    DataConfig,
    ExperimentConfig,
    PlayConfig,
    TrainingConfig,
)
from egovcp_experiment.experiments import EXPERIMENTS
from egovcp_experiment.grid import Grid, Model, parse_flags
from egovcp_experiment.studies.residuals import ResidualsConfig

CONFIGS = {
    "egovcp_collect.collect": ("egovcp_collect.config", "CollectConfig"),
    "egovcp_train.train": ("egovcp_train.config", "TrainConfig"),
    "egovcp_train.ppo.train": ("egovcp_train.ppo.train", "PpoTrainConfig"),
    "egovcp_deploy.evaluate": ("egovcp_deploy.evaluate", "EvalConfig"),
}


def names(cells: Iterable[Cell]) -> list[str]:
    return [cell.name for cell in cells]


def test_variants_share_data_and_models() -> None:
    grid = Grid(ExperimentConfig(train=TrainingConfig(seeds=(0, 1))))
    grid.plays("ball")
    grid.plays("ball", "long", {"planner.horizon": 6})
    grid.plays("ball", "other", model=Model("other", {"policy.hidden": 64}))
    commands = [cell.command for cell in grid.cells]
    assert (commands.count(COLLECT), commands.count(TRAIN), commands.count(PLAY)) == (3, 4, 6)


def test_every_cell_comes_after_those_it_needs() -> None:
    for make, experiment in product(SCALES.values(), EXPERIMENTS.values()):
        before: set[str] = set()
        for cell in experiment.cells(make()):
            assert before.issuperset(cell.needs), cell.name
            before.add(cell.name)


def test_all_experiments_share_the_default_evaluation() -> None:
    config = ExperimentConfig(tasks=("ball", "wall"))
    found = {name: {c.name: c for c in e.cells(config)} for name, e in EXPERIMENTS.items()}
    for name in ("planners", "ppo", "sample-efficiency"):
        for task in ("ball", "wall"):
            play = f"play-{task}-default-s0"
            assert found[name][play].flags == found["ppo"][play].flags
    play = found["generalise"]["play-ball-default-s0"]
    assert play.flags == found["ppo"][play.name].flags
    assert play.flags["policy.path"] == CellOutput("train-all-default-s0", ARTIFACT)
    default = found["ppo"]["train-all-default-s0"]
    assert found["ablations"][default.name] == found["table1"][default.name] == default
    single = found["multitask"]["play-ball-single-s0"].flags
    assert single["policy.path"] == CellOutput("train-ball-default-s0", ARTIFACT)


def test_models_of_one_and_of_all_tasks_learn_for_equally_many_epochs() -> None:
    cells = {c.name: c for c in EXPERIMENTS["multitask"].cells(ExperimentConfig())}
    mixed = cells["train-all-equal_epochs-s0"]
    assert mixed.flags["steps"] == 3 * cells["train-ball-default-s0"].flags["steps"]
    policy = CellOutput(mixed.name, ARTIFACT)
    assert cells["play-ball-mixed-s0"].flags["policy.path"] == policy
    assert cells["latents"].flags["policy.path"] == policy
    training = TrainingConfig(policies={"all": "a/all"})
    given = {c.name: c for c in EXPERIMENTS["multitask"].cells(ExperimentConfig(train=training))}
    assert given["latents"].flags["policy.path"] == ExternalPath("a/all")
    assert not [name for name in given if "equal_epochs" in name]


def test_existing_data_and_policies_are_used() -> None:
    data = DataConfig(roots={"ball": "data/ball"})
    training = TrainingConfig(seeds=(0,), policies={"all": "a/all"})
    grid = Grid(ExperimentConfig(data=data, train=training))
    grid.plays("ball", "single", trained_on="ball")
    grid.plays("wall")
    assert names(grid.cells) == [
        "train-ball-default-s0",
        "play-ball-single-s0",
        "play-wall-default-s0",
    ]
    assert grid.cells[0].flags["dataset.root"] == ExternalPath("data/ball")
    assert grid.cells[2].flags["policy.path"] == ExternalPath("a/all")
    one = Grid(ExperimentConfig(tasks=("ball",), train=training))
    one.plays("ball")
    assert names(one.cells) == ["play-ball-default-s0"]
    assert one.cells[0].flags["policy.path"] == ExternalPath("a/all")


def test_without_seeds_an_experiment_has_its_own() -> None:
    def seeds(name: str, config: ExperimentConfig) -> set[int]:
        cells = EXPERIMENTS[name].cells(config)
        return {cell.flags["seed"] for cell in cells if cell.command is TRAIN}

    small = SCALES["small"]()
    assert seeds("table1", small) == seeds("sample-efficiency", small) == {0, 1, 2}
    assert seeds("generalise", small) == {0}
    given = replace(small, train=replace(small.train, seeds=(4, 5)))
    assert seeds("table1", given) == seeds("generalise", given) == {4, 5}


def test_models_read_the_data_of_all_tasks() -> None:
    grid = Grid(ExperimentConfig(train=TrainingConfig(seeds=(0,))))
    grid.plays("ball")
    train = next(cell for cell in grid.cells if cell.command is TRAIN)
    names = ("collect-ball-5400", "collect-wall-4000", "collect-arch-870")
    assert train.flags["datasets"] == [{"root": CellOutput(name)} for name in names]


@pytest.mark.parametrize("name", ["interpret", "multitask", "planners", "variance"])
def test_studies_use_the_planner_flags_of_egovcp_eval(name: str) -> None:
    config = replace(
        ExperimentConfig(), play=PlayConfig(flags=("--planner.samples=256", "--num_workers=1"))
    )
    studies = [
        cell for cell in EXPERIMENTS[name].cells(config) if ".studies." in cell.command.module
    ]
    assert studies
    for cell in studies:
        assert cell.flags["planner.samples"] == "256"
        assert "num_workers" not in cell.flags


@pytest.mark.parametrize("flags", [(), ("--eta=0.5",), ("--preset=paper",)])
def test_branches_of_variance_walk_as_the_data(flags: tuple[str, ...]) -> None:
    data = parse_config(CollectConfig, flags, "collect", "", partial(preset_defaults, PRESETS))
    cells = EXPERIMENTS["variance"].cells(ExperimentConfig(data=DataConfig(flags=flags)))
    study = next(cell for cell in cells if cell.name.startswith("residuals"))
    walk = {k: v for k, v in study.flags.items() if k in ("eta", "step_ticks", "boundary")}
    found = parse_config(ResidualsConfig, to_argv(walk), "residuals")
    assert (found.eta, found.step_ticks) == (data.eta, data.step_ticks)
    assert found.boundary == data.boundary


def test_timing_cells_are_exclusive() -> None:
    cells = EXPERIMENTS["planners"].cells(ExperimentConfig())
    assert {c.name for c in cells if c.command.exclusive} == {
        f"plan_time-{task}" for task in ("ball", "wall", "arch")
    }


def test_every_command_accepts_the_flags_of_its_cells() -> None:
    """Each distinct value of each flag is parsed once, several flags at a time; flags of a training
    are parsed together because they depend on each other."""
    values: dict[str, dict[str, list[str]]] = {}
    trainings: dict[frozenset[str], list[str]] = {}
    commands: dict[str, Cell] = {}
    for make, experiment in product(SCALES.values(), EXPERIMENTS.values()):
        for cell in experiment.cells(make()):
            commands[cell.command.module] = cell
            argv = [*to_argv(resolve(cell.flags, _any)), *cell.extra]
            if cell.command is TRAIN:
                chosen = frozenset(a for a in argv if not a.startswith(("--seed", "--dataset")))
                trainings[chosen] = argv
                continue
            for name, _, value in (arg.partition("=") for arg in argv):
                known = values.setdefault(cell.command.module, {}).setdefault(name, [])
                if value not in known:
                    known.append(value)
    for module, flags in values.items():
        for k in range(max(map(len, flags.values()))):
            argv = [f"{name}={known[k]}" for name, known in flags.items() if k < len(known)]
            output = f"--{commands[module].command.output}=x"
            parse_config(_config(commands[module]), [output, *argv], "cell")
    train = commands[TRAIN.module]
    for argv in trainings.values():
        parse_config(_config(train), ["--output_dir=x", *argv], "train", "", _option_defaults())


def _any(reference: CellOutput | CellMetric | ExternalPath) -> object:
    """What a reference may stand for."""
    if not isinstance(reference, CellMetric):
        return "folder"
    values: Mapping[str, object] = {"optimiser": "cem"}
    return values.get(reference.keys[-1], 1)


def _config(cell: Cell) -> type[Any]:
    if cell.command.module not in CONFIGS:
        measure = importlib.import_module(cell.command.module).measure
        return get_type_hints(measure)["config"]  # type: ignore[no-any-return]
    module, name = CONFIGS[cell.command.module]
    found: type[Any] = getattr(importlib.import_module(module), name)
    return found


def _option_defaults() -> Any:
    return importlib.import_module("egovcp_train.train").option_defaults


def test_quantities_of_episodes_are_kept_as_columns(tmp_path: Path) -> None:
    episode = {"episode": 0, "steps": 10, "reward": 0.5, "success": True}
    old = [episode, episode | {"episode": 1}]
    new = [each | {"terms": {"hit": -0.5, "block": 1.0}} for each in old]
    episodes = {"ball": {"hold": old, "planner": new}}
    write_json(tmp_path / "eval_run.json", {"episodes": episodes})
    write_json(tmp_path / "eval.json", {"ball": {"hold": {}, "planner": {}}})
    found = PLAY.metrics(tmp_path)["ball"]
    assert found["planner"]["played"]["terms"] == {"hit": [-0.5, -0.5], "block": [1.0, 1.0]}
    assert found["planner"]["played"]["episode"] == [0, 1]
    assert "terms" not in found["hold"]["played"]


def test_a_flag_without_a_value_is_true() -> None:
    found = parse_flags(["--mirror", "--a.b=c=d", "--mirror=", "--resume"])
    assert found == {"mirror": "", "a.b": "c=d", "resume": "true"}
