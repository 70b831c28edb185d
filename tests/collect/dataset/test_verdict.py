"""The verdict doubts what is wrong, and says so."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egovcp.data import ReturnConfig
from egovcp_collect.dataset.occupancy import Occupancy
from egovcp_collect.dataset.survey import Survey, survey
from egovcp_collect.dataset.verdict import Thresholds, judge, summary

from .scenes import three_balls, write_scenes

EASY = Thresholds(moments=1, good_rows=0.0, valid_rows=0.0, occupied=0.0, uniformity=0.0)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    root = tmp_path_factory.mktemp("data") / "three"
    return survey(write_scenes(root, three_balls()), ReturnConfig())


def doubts(found: Survey, limits: Thresholds = EASY, **changes: object) -> list[str]:
    task = replace(found.tasks[0], **changes)
    findings = judge(replace(found, tasks=(task, *found.tasks[1:])), limits)
    return [finding.text for finding in findings if not finding.fine]


def test_nothing_is_doubted_without_a_reason(found: Survey) -> None:
    assert doubts(found) == []
    assert "worth training on" in summary(judge(found, EASY))


def test_few_events_are_doubted_by_default(found: Survey) -> None:
    assert "too few events for Q: 2 episodes" in doubts(found, Thresholds())[0]
    assert "with care" in summary(judge(found, Thresholds()))


def test_rare_events_are_doubted_however_many(found: Survey) -> None:
    (doubt,) = doubts(found, moments=200, steps=10**6)
    assert "too few events for Q: 200 episodes with an event, 0.20 per 1000 steps" in doubt


@pytest.mark.parametrize(("field", "kind"), [("good_moments", "good"), ("bad_moments", "bad")])
def test_a_kind_of_event_that_is_missing_is_doubted(found: Survey, field: str, kind: str) -> None:
    assert doubts(found, **{field: 0}) == [
        f"not a single {kind} event: Q cannot learn what makes one"
    ]


@pytest.mark.parametrize(("share", "advice"), [(0.99, "harder"), (0.0, "easier"), (1.0, "harder")])
def test_one_outcome_is_doubted(found: Survey, share: float, advice: str) -> None:
    (doubt,) = doubts(found, success_share=share)
    assert doubt.startswith("one outcome")
    assert advice in doubt


def test_returns_that_say_nothing_are_doubted(found: Survey) -> None:
    r = found.tasks[0].returns
    assert r.spread is not None
    flat = replace(r, spread=replace(r.spread, std=0.001))
    assert "almost a constant" in doubts(found, returns=flat)[0]
    cut = replace(r, valid_share=0.0, spread=None)
    limits = replace(EASY, valid_rows=0.2)
    assert "only 0% of the rows have a return" in doubts(found, limits, returns=cut)[0]
    poor = replace(EASY, good_rows=0.5)
    assert "a reward ahead that stands out; at least 50%" in doubts(found, poor)[0]


def test_narrow_actions_are_doubted(found: Survey) -> None:
    narrow = Occupancy.of(np.zeros((10, 7)))
    (doubt,) = doubts(found, replace(EASY, uniformity=0.85, occupied=0.5), action=narrow)
    assert doubt.startswith("action occupancy low")
    assert "hand was in 0% of its cells" in doubt


def test_blind_cameras_are_doubted(found: Survey) -> None:
    depth = found.tasks[0].depth
    assert "camera blind" in doubts(found, depth=replace(depth, valid_share=0.01))[0]
    assert "frames are empty" in doubts(found, depth=replace(depth, empty_share=0.5))[0]


def test_a_task_that_is_hardly_there_is_doubted(found: Survey) -> None:
    rest = replace(found.tasks[0], task="wall", step_share=0.9)
    few = replace(found, tasks=(replace(found.tasks[0], step_share=0.1), rest))
    texts = [(f.task, f.text) for f in judge(few, EASY) if not f.fine]
    assert texts == [("ball", "only 10% of the steps; at least 25% of 2 tasks: mix in more")]


def test_limits_can_be_moved_from_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from egovcp_collect.dataset.cli import main

    write_scenes(tmp_path / "three", three_balls())
    flags = ["--limits.moments=1", "--limits.occupied=0", "--limits.uniformity=0"]
    assert main(["coverage", str(tmp_path / "three"), *flags]) == 0
    assert "worth training on: nothing" in capsys.readouterr().out
