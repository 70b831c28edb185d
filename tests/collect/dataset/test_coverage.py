"""`egovcp-dataset coverage`: report, JSON, plots and assessment."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from egovcp import packages
from egovcp.data import DatasetReader, ReturnConfig
from egovcp.data.lerobot import LeRobotReader
from egovcp.data.source import Source
from egovcp.errors import DataError
from egovcp_collect.dataset.cli import main
from egovcp_collect.dataset.coverage import CoverageLimits, _feature_statistics, assess, summary
from egovcp_collect.dataset.statistics import (
    ActionStatistics,
    DatasetStatistics,
    compute_statistics,
)
from egovcp_collect.dataset.task_data import read_rows

from . import damage as d
from .episodes import make_episode, three_balls, write_episodes


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three balls and an arch."""
    folder = tmp_path_factory.mktemp("data") / "four"
    arch = make_episode(3, task="arch", terms=("pass",), length=60, time_limit=60)
    return write_episodes(folder, [*three_balls(), arch]).root


def test_the_assessment_does_not_change_the_exit_code(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["coverage", str(root)]) == 0
    out = capsys.readouterr().out
    assert out.strip().splitlines()[-1].strip().startswith("may be unsuitable for training")
    for word in (
        "block",
        "touch.hands",
        "scene.radius",
        "left_hand.x",
        "warn  ball: 2 episodes with an event",
    ):
        assert word in out


def test_json_replaces_an_existing_file(root: Path, tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    path.write_text("old")
    assert main(["coverage", str(root), f"--json={path}"]) == 0
    found = json.loads(path.read_text())
    assert set(found["tasks"]) == {"ball", "arch"}
    assert found["tasks"]["ball"]["term_rates"]["block"]["ticks"] == 1
    assert found["assessment"]["suitable"] is False
    assert {f["task"] for f in found["assessment"]["checks"]} == {"ball", "arch"}
    assert [p.name for p in tmp_path.iterdir()] == ["c.json"]


def test_four_plots_are_drawn(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert main(["coverage", str(root), "--output_dir=~/new"]) == 0
    drawn = sorted(p.name for p in (tmp_path / "new").iterdir())
    assert drawn == ["actions.png", "depth.png", "events.png", "returns.png"]
    for path in (tmp_path / "new").iterdir():
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("L"))
        assert (pixels < 128).sum() > 500, path  # something dark on white
        assert pixels.shape[1] > 700


def test_plots_of_a_dataset_without_returns_or_events(sound: Path, tmp_path: Path) -> None:
    assert main(["coverage", str(sound), f"--output_dir={tmp_path}"]) == 0
    assert len([*tmp_path.glob("*.png")]) == 4


def test_a_missing_matplotlib_is_reported_before_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(packages, "is_installed", lambda name: name != "matplotlib")
    nowhere = tmp_path / "nowhere"
    assert main(["coverage", str(nowhere), f"--output_dir={tmp_path / 'plots'}"]) == 5
    assert "egovcp-collect[pictures]" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_missing_column_is_named(tmp_path: Path) -> None:
    reader = write_episodes(tmp_path / "one", [make_episode(0, length=4, time_limit=4)])
    path = reader.data_path(0)
    pq.write_table(pq.read_table(path, partitioning=None).drop_columns(["action"]), path)
    with pytest.raises(DataError, match="column action is missing"):
        _feature_statistics(LeRobotReader(reader.root))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_value_that_is_not_finite_is_a_data_error(
    value: float, copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    d.column("next.reward", d.put(14, value))(copy)
    with pytest.raises(DataError, match=f"episode 1, frame 2: next.reward is {value}, expected"):
        read_rows(DatasetReader(Source(copy, "")), ReturnConfig())
    plots = tmp_path / "plots"
    assert main(["coverage", str(copy), f"--output_dir={plots}"]) == 3
    assert f"{d.DATA}, episode 1, frame 2" in capsys.readouterr().err
    assert not plots.exists()


def test_no_dataset_is_a_data_error(tmp_path: Path) -> None:
    assert main(["coverage", f"--dataset.root={tmp_path / 'none'}"]) == 3


def test_returns_over_no_ticks_are_refused(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["coverage", f"--dataset.root={root}", "--returns.steps=0"]) == 2
    assert "--returns.steps=0" in capsys.readouterr().err


EASY = CoverageLimits(
    event_episodes=1, event_frames=0.0, valid_frames=0.0, occupied=0.0, uniformity=0.0
)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> DatasetStatistics:
    root = tmp_path_factory.mktemp("data") / "three"
    return compute_statistics(write_episodes(root, three_balls()), ReturnConfig())


def failed(found: DatasetStatistics, limits: CoverageLimits = EASY, **changes: object) -> list[str]:
    task = replace(found.tasks[0], **changes)
    checks = assess(replace(found, tasks=(task, *found.tasks[1:])), limits)
    return [check.text for check in checks if not check.passed]


def test_all_checks_pass_with_low_limits(found: DatasetStatistics) -> None:
    assert failed(found) == []
    assert "suitable for training: all checks passed" in summary(assess(found, EASY))


def test_few_events_fail_by_default(found: DatasetStatistics) -> None:
    (text, *_) = failed(found, CoverageLimits())
    assert text.startswith("2 episodes with an event, ")
    assert "expected at least 100, and 0.5 per 1000 ticks: collect more" in text
    assert "may be unsuitable" in summary(assess(found))


def test_rare_events_fail(found: DatasetStatistics) -> None:
    (text,) = failed(found, event_episodes=200, frames=10**6)
    assert text.startswith("200 episodes with an event, 0.20 per 1000 ticks; expected at least ")


@pytest.mark.parametrize(
    ("field", "counts"),
    [
        ("success_event_episodes", "0 episodes with a success event, 1 with a failure event"),
        ("failure_event_episodes", "1 episodes with a success event, 0 with a failure event"),
    ],
)
def test_a_missing_kind_of_event_fails(found: DatasetStatistics, field: str, counts: str) -> None:
    assert failed(found, **{field: 0}) == [f"{counts}; expected at least one of each"]


def test_a_task_with_costs_only_needs_no_success_event(found: DatasetStatistics) -> None:
    costs = {"success_event_episodes": 0, "has_success_events": False}
    returns = replace(found.tasks[0].returns, success_event_share=0.0, failure_event_share=0.1)
    limits = replace(EASY, event_frames=0.01)
    assert failed(found, limits, **costs, returns=returns) == []
    (text,) = failed(found, limits, **costs, returns=replace(returns, failure_event_share=0.0))
    assert text.endswith("expected at least 1% with a failure event")
    (text,) = failed(found, limits, **costs, returns=returns, failure_event_episodes=0)
    assert text.endswith("expected at least one with a failure event")


@pytest.mark.parametrize(("share", "advice"), [(0.99, "harder"), (0.0, "easier"), (1.0, "harder")])
def test_a_single_outcome_fails(found: DatasetStatistics, share: float, advice: str) -> None:
    (text,) = failed(found, success_share=share)
    assert text.startswith(f"{share:.0%} of the episodes succeed")
    assert f"expected both outcomes: make the scenes {advice}" in text


def test_uninformative_returns_fail(found: DatasetStatistics) -> None:
    r = found.tasks[0].returns
    assert r.distribution is not None
    (text,) = failed(found, returns=replace(r, distribution=replace(r.distribution, std=0.001)))
    assert "+- 0.001; expected a standard deviation of at least 0.02" in text
    none = replace(r, valid_share=0.0, distribution=None)
    for limits in (EASY, replace(EASY, valid_frames=0.2)):
        (text,) = failed(found, limits, returns=none)
        assert text.startswith("0% of the frames have a return over ")
    (text,) = failed(found, replace(EASY, event_frames=0.5))
    assert text.endswith("a failure event; expected at least 50% with a success event")


def test_narrow_actions_fail(found: DatasetStatistics) -> None:
    narrow = ActionStatistics.of(np.zeros((10, 7)))
    limits = replace(EASY, uniformity=0.85, occupied=0.5)
    uniformity, occupied = failed(found, limits, action=narrow)
    assert uniformity.startswith("lowest uniformity of an action: 0.0")
    cells = "fewest occupied cells of the action box: 0% (left hand)"
    assert occupied == f"{cells}; expected at least 50%"


def test_missing_depth_fails(found: DatasetStatistics) -> None:
    depth = found.tasks[0].depth
    for change in ({"valid_share": 0.01}, {"empty_share": 0.5}):
        (text,) = failed(found, depth=replace(depth, **change))
        assert "expected at least 5% and at most 25%: check the camera" in text


def test_a_rare_task_fails(found: DatasetStatistics) -> None:
    rest = replace(found.tasks[0], task="wall", frame_share=0.9)
    few = replace(found, tasks=(replace(found.tasks[0], frame_share=0.1), rest))
    texts = [(f.task, f.text) for f in assess(few, EASY) if not f.passed]
    text = "10% of the frames; expected at least 25%: collect more of this task"
    assert texts == [("ball", text)]
