"""Options, and the configurations of the scales."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from egovcp.errors import UsageError
from egovcp_experiment.config import SCALES, DataConfig, ExperimentConfig

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", ["README.md", "Makefile"])
def test_documented_commands_tune_neither_model_nor_planner(name: str) -> None:
    text = (ROOT / name).read_text()
    assert not re.findall(
        r"--planner\.|--returns\.|--policy\.(?!path|push|repo|type|device|rev|save_predicted)", text
    )


def test_unknown_variants_and_tasks_are_named() -> None:
    with pytest.raises(UsageError, match="did you mean 'default'"):
        replace(ExperimentConfig(), only=("defualt",)).chosen({"default": 1})
    with pytest.raises(UsageError, match="did you mean 'ball'"):
        ExperimentConfig(output_dir="x", tasks=("bal",)).check()


@pytest.mark.parametrize(
    ("option", "flag", "instead"),
    [
        ("scenes", "--env.task=wall", "give --tasks"),
        ("data.flags", "--seed=3", "give --data.seed"),
        ("train.flags", "--steps=500", "give --train.steps"),
        ("train.flags", "--dataset.root=x", "give --data.roots"),
        ("train.flags", "--resume", "leave it out"),
        ("play.flags", "--eval.n_episodes=5", "give --play.episodes"),
        ("play.flags", "--policy.path=x", "give --train.policies"),
        ("ppo.flags", "--save_freq=1", "give --ppo.policies"),
        ("ppo.flags", "--ppo={num_steps_per_env: 3}", "give --ppo.ticks"),
    ],
)
def test_flags_that_cells_set_are_refused(option: str, flag: str, instead: str) -> None:
    config = ExperimentConfig(output_dir="x")
    group, _, name = option.rpartition(".")
    flags = {name: ("--threads=1", flag)} if group else {name: (flag,)}
    changed = replace(getattr(config, group), **flags) if group else flags[name]
    config = replace(config, **{group or name: changed})  # type: ignore[arg-type]
    with pytest.raises(UsageError) as error:
        config.check()
    assert str(error.value) == f"--{option} holds {flag}, which the experiment sets; {instead}"


def test_flags_that_cells_do_not_set_are_accepted() -> None:
    for scale in SCALES.values():
        replace(scale(), output_dir="x").check()
    data = DataConfig(flags=("--preset=paper", "--env.controller=stance"))
    ExperimentConfig(output_dir="x", data=data).check()


@pytest.mark.parametrize("scale", ["small", "paper"])
def test_all_trainings_draw_the_same_windows(scale: str) -> None:
    assert "--loading.mode=ram" in SCALES[scale]().train.flags


@pytest.mark.parametrize("scale", ["small", "paper"])
def test_results_are_measured_on_scenarios_that_nothing_was_tuned_on(scale: str) -> None:
    assert SCALES[scale]().play.seed not in range(10)
