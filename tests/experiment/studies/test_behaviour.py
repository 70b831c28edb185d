"""Behaviour follows from the traces of hands and pelvis."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egovcp_experiment.cell import read_json
from egovcp_experiment.studies.behaviour import BehaviourTrace, main

TICK = 0.04


def track(reach: list[float], speed: list[float]) -> BehaviourTrace:
    """One hand `reach` m ahead of its start and the pelvis at `speed` m/s in each tick; the push
    comes at tick 1."""
    hands = [np.array([[0.3 + r, 0.2, 0.1], [0.3, -0.2, 0.1]]) for r in reach]
    since = [(t - 1) * TICK for t in range(len(reach))]
    zeros = [0.0] * len(reach)
    return BehaviourTrace(since, hands, [np.zeros(7)] * len(reach), zeros, speed, zeros)


def test_the_further_hand_counts() -> None:
    np.testing.assert_allclose(track([0.0, 0.4], [0, 0]).hand_distance_m, [0.0, 0.4])


def test_hands_that_return_after_recovery_are_back() -> None:
    pushed = [0.5] * 20
    still = [0.0] * 60
    reach = [0.0, *[0.4] * 40, *[0.05] * 39]
    assert track(reach, [*pushed, *still]).hands_back is True


def test_hands_that_stay_up_are_not_back() -> None:
    assert track([0.0, *[0.4] * 99], [*[0.5] * 20, *[0.0] * 80]).hands_back is False


def test_episodes_without_recovery_are_not_judged() -> None:
    never_slow = track([0.0, *[0.4] * 79], [0.5] * 80)
    too_short = track([0.0, *[0.4] * 39], [*[0.5] * 10, *[0.0] * 30])
    fallen = track([0.0, *[0.4] * 99], [*[0.5] * 20, *[0.0] * 80])
    fallen.fallen = True
    assert [t.hands_back for t in (never_slow, too_short, fallen)] == [None, None, None]


def test_the_time_to_contact_counts_from_the_push() -> None:
    trace = track([0.0] * 5, [0.0] * 5)
    assert trace.since_event_s[0] < 0
    trace.hands_on = [True, False, False, True, True]
    assert trace.contact_s == pytest.approx(3 * TICK)  # to the end of the third tick
    trace.hands_on = [True, *[False] * 4]
    assert trace.contact_s is None


@pytest.mark.parametrize(
    ("task", "key"),
    [
        ("ball", "empty_scene"),
        pytest.param("wall", "empty_scene", marks=pytest.mark.slow),
        pytest.param("arch", "pelvis_far", marks=pytest.mark.slow),
    ],
)
def test_every_task_is_measured(task: str, key: str, flags: list[str], tmp_path: Path) -> None:
    assert main([*flags, f"--task={task}"]) == 0
    found = read_json(tmp_path / "out" / "result.json")
    assert found["task"] == task
    assert found[key]["episodes"] >= 2
    assert 0 < found[key]["mean"] < 1
    if task == "wall":
        assert found["hand_contact"]["episodes"] == found["pushed"]
        costs = found["bracing_q"]["mean"] - found["bracing_j"]["mean"]
        assert found["bracing_q"]["episodes"] == found["pushed"]
        assert costs > 0


@pytest.mark.slow
def test_planner_options_change_the_planner(
    flags: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["--task=ball", *flags, "--planner.samples=3", "--planner.elites=2"]
    assert main(argv) == 0
    assert main([*argv, "--planner.samples=1", f"--output_dir={tmp_path / 'two'}"]) == 2
    assert "planner.elites=2 exceeds planner.samples=1; lower it" in capsys.readouterr().err


def test_an_artifact_of_another_controller_is_refused(
    flags: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*flags, "--env.controller=stance"]) == 4
    assert "low-level controller" in capsys.readouterr().err
