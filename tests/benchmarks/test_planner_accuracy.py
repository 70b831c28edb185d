"""The states that the accuracy of the planner is measured on, and its planner."""

import json
from dataclasses import replace
from pathlib import Path

import planner_accuracy
import pytest
from planner_accuracy import states
from writer import make_episode, write_dataset

from egovcp.artifact import save_artifact
from egovcp.model import PRESETS
from egovcp.plan import PlannerConfig
from egovcp.testing import toy_model


def test_a_dataset_may_have_fewer_episodes_than_are_wanted(tmp_path: Path) -> None:
    write_dataset(tmp_path / "dataset", [make_episode(i, 4) for i in range(2)])
    model = toy_model().requires_grad_(False)
    carry, before = states(model, str(tmp_path / "dataset"), episodes=20, every=2)
    assert len(carry.h) == len(before) == 4


def test_the_planner_is_the_policys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    used = []
    make = planner_accuracy.make_evaluator
    monkeypatch.setattr(planner_accuracy, "BACKENDS", ("float32",))
    monkeypatch.setattr(
        planner_accuracy, "make_evaluator", lambda m, c: used.append(c) or make(m, c)
    )
    planner = PlannerConfig(objective="td", horizon=2, iterations=1)
    config = replace(PRESETS["debug"], loss=replace(PRESETS["debug"].loss, reward=1.0))
    save_artifact(tmp_path / "policy", toy_model(config), planner, {"controller_id": "walk-1"})
    write_dataset(tmp_path / "dataset", [make_episode(0, 8)])
    flags = f"--policy {tmp_path / 'policy'} --dataset {tmp_path / 'dataset'} --samples 8"
    out = tmp_path / "metrics.json"
    monkeypatch.setattr("sys.argv", ["planner_accuracy.py", *flags.split(), "--json", str(out)])
    planner_accuracy.main()
    own = replace(planner, samples=8, elites=2)
    assert used == [replace(own, backend=name) for name in ("eager", "float32", "eager")]
    assert json.loads(out.read_text())["float32_value_lost_mean"] < 0.01
