"""The states that the accuracy of the planner is measured on."""

from pathlib import Path

from planner_accuracy import states
from writer import make_episode, write_dataset

from egovcp.testing import toy_model


def test_a_dataset_may_have_fewer_episodes_than_are_wanted(tmp_path: Path) -> None:
    write_dataset(tmp_path / "dataset", [make_episode(i, 4) for i in range(2)])
    model = toy_model().requires_grad_(False)
    carry, before = states(model, str(tmp_path / "dataset"), episodes=20, every=2)
    assert len(carry.h) == len(before) == 4
