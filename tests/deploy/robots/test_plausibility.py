"""Readings that no G1 can produce are rejected; those of a healthy robot are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings
from egovcp.robot.g1 import VELOCITY_LIMIT
from egovcp.spec import JOINT_NAMES
from egovcp_deploy.pilot.states import Limits
from egovcp_deploy.robots.base import LowState
from egovcp_deploy.robots.plausibility import JUMP_RESYNC_S, RESYNC_S, PlausibilityFilter
from tests.support.robots.healthy_run import HealthyRun, Situation

KNEE = JOINT_NAMES.index("left_knee_joint")
STEP_NS = 5_000_000
ONSET = 40

Array = NDArray[np.float64]


@dataclass
class StandingReadings:
    """Sensor readings of a robot that stands still, with noise."""

    rng: np.random.Generator
    position: Array = field(init=False)
    speed: Array = field(init=False)
    rate: Array = field(init=False)
    quaternion: Array = field(init=False)
    torque: Array = field(init=False)

    def __post_init__(self) -> None:
        self.position = self.rng.normal(0, 0.002, 29)
        self.speed = self.rng.normal(0, 0.05, 29)
        self.rate = self.rng.normal(0, 0.03, 3)
        self.quaternion = np.array([1.0, 0.0, 0.0, 0.0])
        self.torque = np.zeros(29)

    def at(self, time_ns: int) -> LowState:
        parts = (self.position, self.speed, self.quaternion, self.rate)
        return LowState(time_ns, *parts, motors=MotorReadings(self.torque))


Change = Callable[[StandingReadings], None]


def problems(change: Change, duration: int = 60, step_ns: int = STEP_NS) -> list[str]:
    """Of ``duration`` readings from the onset of ``change``; none may be rejected before."""
    rng = np.random.default_rng(0)
    plausibility, found = PlausibilityFilter(), list[str]()
    for k in range(ONSET + duration):
        reading = StandingReadings(rng)
        if k >= ONSET:
            change(reading)
        found.append(plausibility.check(reading.at(k * step_ns)))
    assert not any(found[:ONSET])
    return found[ONSET:]


def speed(value: float) -> Change:
    return lambda reading: reading.speed.__setitem__(KNEE, value)


def all_speeds(reading: StandingReadings) -> None:
    reading.speed[:] = 190.0 * (-1.0) ** np.arange(29)


def rate(value: float) -> Change:
    return lambda reading: reading.rate.__setitem__(0, value)


def position(change: float) -> Change:
    return lambda reading: reading.position.__setitem__(KNEE, reading.position[KNEE] + change)


def torque(value: float) -> Change:
    return lambda reading: reading.torque.__setitem__(KNEE, value)


def rolled(reading: StandingReadings) -> None:
    reading.quaternion = np.array([np.cos(0.4), np.sin(0.4), 0.0, 0.0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (rate(150.0), "gyroscope x (rad/s) is 150.00, expected -34.91 to 34.91"),
        (speed(190.0), "left_knee_joint speed (rad/s) is 190.00, expected -30.00 to 30.00"),
        (speed(float("nan")), "left_knee_joint speed"),
        (all_speeds, "left_hip_pitch_joint speed"),
        (position(9.0), "left_knee_joint position (rad) is 9.00"),
        (torque(900.0), "left_knee_joint torque (N m) is 900.00"),
    ],
)
def test_readings_out_of_bounds_are_rejected(change: Change, words: str) -> None:
    found = problems(change)
    assert all(found)
    assert words in found[0]


@pytest.mark.parametrize("step_ns", [2_000_000, 5_000_000, 20_000_000])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (speed(25.0), "left_knee_joint"),
        (rate(20.5), "gyroscope x"),
        (position(0.5), "left_knee_joint moved by"),
        (rolled, "but the pelvis turned by +0.78"),
    ],
)
def test_contradictions_are_rejected_at_every_rate(
    change: Change, words: str, step_ns: int
) -> None:
    """Within bounds, but in contradiction to the readings before; one may pass at low rates."""
    found = problems(change, duration=round(RESYNC_S * 1e9 / step_ns) - 2, step_ns=step_ns)
    assert all(found[1:])
    assert any(words in problem for problem in found)


def test_the_reason_names_the_joint_and_the_values() -> None:
    reason = problems(speed(25.0))[-1]
    assert "left_knee_joint moved by" in reason
    assert "now +25.0 rad/s" in reason


def test_only_the_implausible_reading_is_rejected() -> None:
    def once(change: Change) -> Change:
        count = iter(range(1000))
        return lambda reading: change(reading) if next(count) == 0 else None

    for change in (rate(150.0), speed(190.0), position(0.5), torque(900.0), rolled):
        found = problems(once(change))
        assert found[0]
        assert not any(found[1:])


def test_random_readings_within_bounds_are_rejected() -> None:
    rng = np.random.default_rng(1)

    def wild(reading: StandingReadings) -> None:
        reading.position = rng.uniform(-0.2, 0.2, 29)
        reading.speed = rng.uniform(-1, 1, 29) * VELOCITY_LIMIT

    assert all(problems(wild))


def test_a_position_jump_is_accepted_after_the_damping_limit() -> None:
    found = problems(position(0.5), duration=200)
    accepted = found.index("")
    assert Limits().state_damp_s < accepted * STEP_NS * 1e-9 < 2 * RESYNC_S
    assert not any(found[accepted:])


def test_a_speed_jump_is_accepted_once_positions_follow() -> None:
    ticks = iter(range(1000))

    def moved(reading: StandingReadings) -> None:
        reading.speed[KNEE] = 25.0
        reading.position[KNEE] += 25.0 * next(ticks) * STEP_NS * 1e-9

    found = problems(moved, duration=12)
    accepted = found.index("")
    assert 0 < accepted * STEP_NS * 1e-9 <= JUMP_RESYNC_S + STEP_NS * 1e-9
    assert not any(found[accepted:])


@pytest.mark.parametrize(
    "situation",
    [
        Situation("steered and pushed", "ball", steered=True),
        Situation("wall", "wall"),
    ],
    ids=lambda situation: situation.name,
)
def test_a_healthy_robot_causes_no_false_alarm(situation: Situation) -> None:
    """``benchmarks/false_alarms.py`` plays ten minutes of this."""
    healthy = HealthyRun(situation)
    healthy.play(0, max_s=8.0)
    assert healthy.alarms.seconds > 4.0
    assert healthy.alarms.readings > 800
    assert healthy.alarms.rejected == []
    assert healthy.alarms.events == []
