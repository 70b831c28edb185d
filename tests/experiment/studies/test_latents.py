"""Neighbours say what is in the states; the study writes a map of every one."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from egovcp_experiment.studies.latents import main, neighbours
from egovcp_experiment.tools import read_json


def states() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Task, episode and tick of 2 tasks x 4 episodes x 20 ticks."""
    task, episode, tick = (
        part.flatten() for part in torch.meshgrid(*map(torch.arange, (2, 4, 20)), indexing="ij")
    )
    return task, episode, tick


def test_states_that_tell_task_and_time_are_recognised() -> None:
    task, episode, tick = states()
    found = neighbours(torch.stack([100.0 * task, 1.0 * tick], 1), task, episode, tick)
    assert found["same_task"] == 1.0
    assert found["chance"] == pytest.approx(0.5)
    assert found["tick_r2"] > 0.95


def test_noise_tells_neither() -> None:
    task, episode, tick = states()
    points = torch.randn(len(task), 4, generator=torch.Generator().manual_seed(0))
    found = neighbours(points, task, episode, tick)
    assert found["same_task"] == pytest.approx(0.5, abs=0.1)
    assert found["tick_r2"] < 0.2


def test_the_own_episode_does_not_count() -> None:
    """States that know nothing but their episode have neighbours in none."""
    task, episode, tick = states()
    points = (10.0 * episode + 100.0 * (task * 4 + episode) ** 2)[:, None] + 0.001 * tick[:, None]
    found = neighbours(points, task, episode, tick)
    assert found["tick_r2"] < 0.5


def test_every_task_is_in_the_maps(flags: list[str], tmp_path: Path) -> None:
    assert main([*flags, "--tasks=[ball,wall]", "--points=40"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert set(found["task"]) == {0, 1}
    assert len(found["h"]["map"]) == len(found["z"]["map"]) == len(found["tick"]) == 40
