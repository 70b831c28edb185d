"""What README and Makefile tell people to type plans as the scale does whose reports they show."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from egovcp.spec import TASKS
from egovcp_experiment.scales import small

ROOT = Path(__file__).resolve().parents[2]


def planner_flags(command: str) -> dict[str, str]:
    return dict(re.findall(r"--planner\.(\w+)=([^\s\"]+)", command))


def chosen(task: str) -> dict[str, str]:
    play = small().play
    return planner_flags(" ".join((*play.flags, *play.task_flags.get(task, ()))))


@pytest.mark.parametrize("task", TASKS)
def test_readme_trains_a_task_with_the_planner_of_the_reports(task: str) -> None:
    readme = (ROOT / "README.md").read_text()
    variables = dict(re.findall(r'^(\w+)="([^"]*)"$', readme, re.MULTILINE))
    (line,) = re.findall(
        rf"^egovcp-train \$train .*--output_dir=runs/{task}$", readme, re.MULTILINE
    )
    command = re.sub(r"\$(\w+)", lambda name: variables[name[1]], line)
    assert planner_flags(command) == chosen(task)


def test_quickstart_trains_the_ball_with_the_planner_of_the_reports() -> None:
    (line,) = re.findall(r"^PLANNER := .*$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert planner_flags(line) == chosen("ball")
