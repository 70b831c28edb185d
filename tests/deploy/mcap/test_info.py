"""`egovcp-mcap info`: state changes with their reasons, and maxima per joint."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egovcp.log.tick import MotorReadings, Tick
from egovcp_deploy.mcap.cli import main
from egovcp_deploy.mcap.info import summarise

from .conftest import Record

MODES = ["armed", "run", "run", "hold", "hold", "hold", "damp", "damp"]
EVENTS = {
    1: ("armed -> run: the operator asked for it",),
    3: ("warning: hot", "run -> hold: no new picture for 210 ms"),
    6: ("hold -> damp: the pelvis is tilted by 1.10 rad",),
    7: ("end of the run: the motors are damped",),
}


def live(tick: Tick) -> Tick:
    """As a run of a robot has it."""
    k = tick.index
    motors = MotorReadings(
        torque=np.where(np.arange(29) == 3, -10.0 * k, 1.0),
        temperature=np.stack([np.full(29, 30.0 + k), np.full(29, np.nan)], axis=1),
    )
    return replace(tick, mode=MODES[k], events=EVENTS.get(k, ()), motors=motors)


def test_state_changes_have_time_and_reason(record: Record) -> None:
    changes = summarise(record(keep=live))[0]["states"]
    assert [(c["before"], c["after"], c["reason"]) for c in changes] == [
        ("armed", "run", "the operator asked for it"),
        ("run", "hold", "no new picture for 210 ms"),
        ("hold", "damp", "the pelvis is tilted by 1.10 rad"),
    ]
    assert [c["time_s"] for c in changes] == pytest.approx([0.04, 0.12, 0.24])


def test_info_as_text(record: Record, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(record(keep=live))]) == 0
    out = capsys.readouterr().out
    assert "    0.24 s  hold -> damp: the pelvis is tilted by 1.10 rad" in out
    assert "last event  end of the run: the motors are damped" in out
    knee = next(line for line in out.splitlines() if line.startswith("left_knee_joint"))
    assert knee.split() == ["left_knee_joint", "70.0", "N", "m", "37", "deg", "C"]


def test_info_as_json(record: Record, tmp_path: Path) -> None:
    assert main(["info", str(record(keep=live)), f"--json={tmp_path / 'i.json'}"]) == 0
    report = json.loads((tmp_path / "i.json").read_text())
    assert report["states"][-1]["reason"] == "the pelvis is tilted by 1.10 rad"
    assert report["joint_maxima"]["left_knee_joint"] == {
        "torque_nm": 70.0,
        "temperature_deg_c": 37.0,
    }


def test_a_torque_that_is_never_finite_is_null(
    record: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    torque = np.where(np.arange(29) == 3, np.nan, 1.0)
    file = record(keep=lambda tick: replace(tick, motors=MotorReadings(torque)))
    assert main(["info", str(file), "--json=-"]) == 0
    maxima = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)["joint_maxima"]
    assert [m["torque_nm"] for m in maxima.values()] == [1.0] * 3 + [None] + [1.0] * 25
    assert main(["info", str(file)]) == 0
    assert "\nleft_knee_joint\n" in capsys.readouterr().out


@pytest.mark.parametrize("shapes", [((28,), (29, 1)), ((29,), (28, 1))])
def test_motors_of_another_robot_are_damage(
    shapes: tuple[tuple[int, ...], ...], record: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    motors = MotorReadings(*(np.ones(shape) for shape in shapes))
    file = record(keep=lambda tick: replace(tick, motors=motors if tick.index == 2 else None))
    assert main(["info", str(file)]) == 3
    assert "tick 2 has torques of" in capsys.readouterr().err


def test_a_recording_without_motors_has_no_table(
    record: Record, capsys: pytest.CaptureFixture[str]
) -> None:
    file = record()
    assert main(["info", str(file)]) == 0
    assert "max torque" not in capsys.readouterr().out
    assert summarise(file)[0]["joint_maxima"] is None
