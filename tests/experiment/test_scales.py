"""All tasks share one recipe, which the defaults hold."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from egovcp_experiment.scales import SCALES

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", ["README.md", "Makefile"])
def test_documented_commands_tune_neither_model_nor_planner(name: str) -> None:
    text = (ROOT / name).read_text()
    assert not re.findall(
        r"--planner\.|--returns\.|--policy\.(?!path|push|repo|type|device|rev)", text
    )


@pytest.mark.parametrize("name", SCALES)
def test_all_tasks_have_the_same_options(name: str) -> None:
    config = SCALES[name]()
    assert config.train.task_flags == config.play.task_flags == {}
