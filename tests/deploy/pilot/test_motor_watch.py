"""Hot, faulty and dead motors: warned of, not armed with, held, damped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egovcp.log.tick import MotorReadings
from egovcp.robot.g1 import DAMPING, STIFFNESS
from egovcp.spec import JOINT_NAMES
from egovcp_deploy.pilot.motor_watch import CASING, SINGLE, WINDING, MotorVerdict, MotorWatch
from egovcp_deploy.robots.base import LowState, MotorCommand

TICK_NS = 20_000_000
KNEE = JOINT_NAMES.index("left_knee_joint")
ANKLE = JOINT_NAMES.index("left_ankle_roll_joint")
ZERO = np.zeros(29)
HEALTHY = MotorReadings(
    torque=np.full(29, 0.5),
    temperature=np.full((29, 2), 35.0),
    faults=np.zeros(29, np.int64),
    enabled=np.ones(29, np.bool_),
)
HOLD_STILL = MotorCommand(ZERO, STIFFNESS, DAMPING)


def reading(time_ns: int, motors: MotorReadings, position: np.ndarray = ZERO) -> LowState:
    upright = np.array([1.0, 0, 0, 0])
    return LowState(time_ns, position, ZERO, upright, np.zeros(3), motors=motors)


class WatchRig:
    """A watch and its clock; collects all events."""

    def __init__(self) -> None:
        self.watch, self.time_ns, self.events = MotorWatch(), 0, list[str]()

    def run(
        self,
        seconds: float,
        motors: MotorReadings = HEALTHY,
        command: MotorCommand | None = HOLD_STILL,
        position: np.ndarray = ZERO,
    ) -> MotorVerdict:
        verdict = MotorVerdict()
        for _ in range(round(seconds * 50)):
            self.time_ns += TICK_NS
            verdict = self.watch.update(reading(self.time_ns, motors, position), command)
            self.events += verdict.events
        return verdict


def heated(joint: int, casing: float, winding: float) -> MotorReadings:
    temperature = HEALTHY.temperature.copy()
    temperature[joint] = casing, winding
    return replace(HEALTHY, temperature=temperature)


def torques(joint: int, torque: float) -> MotorReadings:
    values = HEALTHY.torque.copy()
    values[joint] = torque
    return replace(HEALTHY, torque=values)


def test_healthy_motors_give_no_events() -> None:
    rig = WatchRig()
    assert rig.run(30.0) == MotorVerdict()
    assert rig.events == []


@pytest.mark.parametrize(("column", "limits"), [(0, CASING), (1, WINDING)])
def test_a_heating_motor_is_warned_of_then_refused_then_held(
    column: int, limits: tuple[float, float, float]
) -> None:
    rig = WatchRig()
    temperatures = [35.0, 35.0]

    def at(degrees: float) -> MotorVerdict:
        temperatures[column] = degrees
        return rig.run(1.0, heated(ANKLE, *temperatures))

    assert at(limits[0] - 1) == MotorVerdict()
    assert rig.events == []
    assert at(limits[0]) == MotorVerdict()
    assert len(rig.events) == 1
    assert rig.events[0].startswith("warning: the motor of left_ankle_roll_joint is hot: casing")
    assert "left_ankle_roll_joint" in at(limits[1]).arming_refusal
    assert not at(limits[2] - 1).hold
    hot = at(limits[2])
    assert "left_ankle_roll_joint is too hot" in hot.hold
    assert "let the robot down" in hot.hold
    assert not hot.damp
    assert hot.hold in rig.events
    assert at(limits[1] + 1).hold, "held until it may be armed again"
    assert at(limits[1] - 1) == MotorVerdict()


def test_a_single_hot_reading_holds_nothing() -> None:
    rig = WatchRig()
    rig.run(1.0)
    assert not rig.run(0.1, heated(KNEE, 35.0, 200.0)).hold
    assert not rig.run(1.0).hold


def test_one_temperature_per_motor_has_its_own_limits_and_is_logged_once() -> None:
    rig = WatchRig()
    temperature = np.full((29, 1), 35.0)
    single = replace(HEALTHY, temperature=temperature)
    assert rig.run(5.0, single) == MotorVerdict()
    assert len(rig.events) == 1
    assert "one temperature per motor" in rig.events[0]
    temperature[KNEE] = SINGLE.hold
    assert "left_knee_joint is too hot: 80 deg C" in rig.run(1.0, single).hold


def test_the_reminder_comes_every_ten_seconds() -> None:
    rig = WatchRig()
    rig.run(25.0, heated(KNEE, 35.0, 130.0))
    assert sum("let the robot down" in event for event in rig.events) == 3


def test_an_overheated_robot_stays_held_when_its_temperatures_stop_arriving() -> None:
    rig = WatchRig()
    assert rig.run(1.0, heated(ANKLE, 35.0, 125.0)).hold
    assert "no longer report temperatures" in rig.run(5.0, replace(HEALTHY, temperature=None)).hold


@pytest.mark.parametrize("columns", [1, 2])
def test_a_hot_motor_whose_sensor_fails_stays_held_until_it_reports_that_it_is_cool(
    columns: int,
) -> None:
    rig = WatchRig()

    def at(degrees: float) -> MotorReadings:
        return replace(heated(ANKLE, 35.0, degrees), temperature=temperatures(degrees))

    def temperatures(degrees: float) -> np.ndarray:
        found = np.full((29, columns), 35.0)
        found[ANKLE, -1] = degrees
        return found

    assert "left_ankle_roll_joint is too hot" in rig.run(1.0, at(125.0)).hold
    verdict = rig.run(5.0, at(np.nan))
    assert "left_ankle_roll_joint was too hot and no longer reports a temp" in verdict.hold
    assert verdict.arming_refusal
    assert rig.run(0.1, at(40.0)) == MotorVerdict()
    assert rig.run(1.0, at(np.nan)) == MotorVerdict(), "it was cool when it was last seen"


def test_each_of_two_hot_motors_must_report_that_it_is_cool() -> None:
    rig = WatchRig()
    temperature = HEALTHY.temperature.copy()
    temperature[[KNEE, ANKLE], 1] = 125.0
    assert rig.run(1.0, replace(HEALTHY, temperature=temperature)).hold
    temperature = HEALTHY.temperature.copy()
    temperature[ANKLE, 1] = np.nan
    assert "left_ankle_roll_joint" in rig.run(1.0, replace(HEALTHY, temperature=temperature)).hold
    assert rig.run(0.1) == MotorVerdict()


def test_an_overloaded_robot_stays_held_when_its_status_stops_arriving() -> None:
    rig = WatchRig()
    faults = np.zeros(29, np.int64)
    faults[KNEE] = 0x1
    assert rig.run(1.0, replace(HEALTHY, faults=faults)).hold
    hold = rig.run(1.0, replace(HEALTHY, faults=None)).hold
    assert "left_knee_joint reports overcurrent (0x1); motors no longer report their status" in hold
    assert rig.run(0.1) == MotorVerdict()


def test_heat_is_warned_of_while_a_motor_is_overloaded() -> None:
    rig, hot = WatchRig(), heated(ANKLE, 35.0, 95.0)
    faults = np.zeros(29, np.int64)
    faults[ANKLE] = 0x1  # overcurrent
    rig.run(1.0, replace(hot, faults=faults))
    assert any("is hot" in event for event in rig.events)


def test_missing_fields_are_logged_once_and_other_checks_continue() -> None:
    rig = WatchRig()
    bare = MotorReadings(torque=HEALTHY.torque)
    assert rig.run(5.0, bare) == MotorVerdict()
    assert rig.events == [
        "checks that are off, as they are not reported by the robot: motor temperatures, motor "
        "status bits, motor modes"
    ]
    assert rig.watch.update(replace(reading(10**12, bare), motors=None), None) == MotorVerdict()


def test_a_field_that_disappears_is_logged() -> None:
    rig = WatchRig()
    rig.run(1.0)
    rig.run(1.0, replace(HEALTHY, temperature=None))
    assert rig.events == [
        "checks that are off, as they are no longer reported by the robot: motor temperatures"
    ]


@pytest.mark.parametrize(
    ("bits", "words"),
    [(0x80000000, "lost the connection to the motor"), (0x1000, "output encoder (0x1000)")],
)
def test_a_motor_whose_status_says_that_it_dropped_out_is_damped(bits: int, words: str) -> None:
    rig = WatchRig()
    rig.run(1.0)
    faults = np.zeros(29, np.int64)
    faults[KNEE] = bits
    motors = replace(HEALTHY, faults=faults)
    assert not rig.run(0.02, motors).damp, "one reading is not believed"
    damp = rig.run(0.1, motors).damp
    assert "left_knee_joint does not follow commands" in damp
    assert words in damp


def test_a_motor_that_is_no_longer_enabled_is_damped() -> None:
    rig = WatchRig()
    rig.run(1.0, replace(HEALTHY, enabled=np.arange(29) < 20))
    assert rig.run(1.0, replace(HEALTHY, enabled=np.arange(29) < 20)).damp == "", "never was"
    enabled = np.arange(29) < 20
    enabled[KNEE] = False
    damp = rig.run(0.1, replace(HEALTHY, enabled=enabled)).damp
    assert "left_knee_joint does not follow commands: its mode is off" in damp


def test_an_overloaded_motor_is_held_and_a_sensor_fault_forbids_arming_only() -> None:
    rig = WatchRig()
    faults = np.zeros(29, np.int64)
    faults[KNEE] = 0x1
    verdict = rig.run(0.1, replace(HEALTHY, faults=faults))
    assert "left_knee_joint reports overcurrent" in verdict.hold
    assert not verdict.damp
    faults = np.zeros(29, np.int64)
    faults[KNEE] = 0x100
    verdict = rig.run(0.1, replace(HEALTHY, faults=faults))
    assert "casing temperature sensor" in verdict.arming_refusal
    assert (verdict.hold, verdict.damp) == ("", "")


def test_a_motor_without_torque_although_much_is_commanded_is_damped_with_its_name() -> None:
    rig = WatchRig()
    rig.run(1.0)
    command = replace(HOLD_STILL, position=np.where(np.arange(29) == KNEE, 0.4, 0.0))
    dead = torques(KNEE, 0.3)
    assert not rig.run(0.1, dead, command).damp
    damp = rig.run(0.1, dead, command).damp
    assert "left_knee_joint does not follow its target: torque 0.3 N m" in damp


@pytest.mark.parametrize("torque", [40.0, 10.0, -20.0])
def test_a_motor_that_works_against_a_load_is_not_damped(torque: float) -> None:
    rig = WatchRig()
    command = replace(HOLD_STILL, position=np.where(np.arange(29) == KNEE, 0.4, 0.0))
    assert rig.run(5.0, torques(KNEE, torque), command) == MotorVerdict()


def test_a_target_that_alternates_each_tick_is_no_fault() -> None:
    rig = WatchRig()
    rig.run(1.0)
    for k in range(100):
        away = np.where(np.arange(29) == KNEE, 0.4 * (-1) ** k, 0.0)
        assert not rig.run(0.02, HEALTHY, replace(HOLD_STILL, position=away)).damp


def test_a_robot_that_estimates_no_torque_is_not_29_dead_motors() -> None:
    rig = WatchRig()
    command = replace(HOLD_STILL, position=np.full(29, 0.4))
    assert rig.run(5.0, replace(HEALTHY, torque=ZERO), command) == MotorVerdict()


def test_a_repeated_reading_changes_nothing() -> None:
    watch = MotorWatch()
    command = replace(HOLD_STILL, position=np.full(29, 0.4))
    watch.update(reading(1, HEALTHY), command)
    late = reading(2, torques(KNEE, 0.0))
    assert not any(watch.update(late, command).damp for _ in range(100))
