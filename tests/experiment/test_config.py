"""Options, and the configurations of the scales."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from egovcp.errors import UsageError
from egovcp_experiment.config import SCALES, ExperimentConfig

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


@pytest.mark.parametrize("scale", ["small", "paper"])
def test_results_are_measured_on_scenarios_that_nothing_was_tuned_on(scale: str) -> None:
    assert SCALES[scale]().play.seed not in range(10)
