"""README and Makefile train with the planner options of the scale whose reports they show."""

from __future__ import annotations

from pathlib import Path

import pytest

from egovcp_experiment.scales import PLANNER, SCALES, small

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", ["README.md", "Makefile"])
def test_the_documented_training_has_the_planner_of_the_reports(name: str) -> None:
    text = (ROOT / name).read_text().replace("\\\n", " ")
    assert " ".join(PLANNER) in " ".join(text.split())


def test_the_planner_is_stored_in_the_trained_policy() -> None:
    config = small()
    assert set(PLANNER) <= set(config.train.flags)
    assert not [flag for flag in config.play.flags if flag.startswith("--planner.")]


@pytest.mark.parametrize("name", SCALES)
def test_all_tasks_have_the_same_options(name: str) -> None:
    config = SCALES[name]()
    assert config.train.task_flags == config.play.task_flags == {}
