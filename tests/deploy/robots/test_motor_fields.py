"""Optional fields of the motors on the wire: read where they are, never required."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from egovcp.log.tick import MotorReadings
from egovcp_deploy.robots.body import BodyState
from egovcp_deploy.robots.motor_fields import fault_words
from egovcp_deploy.robots.wire import LowState, decode_state, encode_state

COUNT = np.arange(29)
FULL = MotorReadings(
    torque=COUNT / 2.0,
    temperature=np.stack([30.0 + COUNT, 40.0 + COUNT], axis=1),
    faults=np.where(COUNT == 3, 0x80000000, 0),
    lost=COUNT,
    enabled=COUNT != 3,
)


def message(motors: MotorReadings = FULL) -> bytes:
    zero = np.zeros(29)
    body = BodyState(0, zero, zero, np.array([1.0, 0, 0, 0]), np.zeros(3), motors=motors)
    return encode_state(LowState(body), np.array([0.0, 0.0, 9.81]))


def read(payload: bytes) -> MotorReadings:
    return decode_state(payload, 1).motors


def changed(change: Callable[[dict[str, Any]], object]) -> MotorReadings:
    """Of the full message, after ``change`` of each motor."""
    parsed = json.loads(message())
    for motor in parsed["data"]["motor_state"]:
        change(motor)
    return read(json.dumps(parsed).encode())


def test_all_fields_survive_the_wire() -> None:
    back = read(message())
    for name in ("torque", "temperature", "faults", "lost", "enabled"):
        np.testing.assert_array_equal(getattr(back, name), getattr(FULL, name))


def test_the_names_on_the_wire_are_those_of_unitree() -> None:
    motor = json.loads(message())["data"]["motor_state"][3]
    assert motor["temperature"] == [33.0, 43.0]
    assert (motor["motorstate"], motor["lost"], motor["mode"]) == (0x80000000, 3, 0)


def test_one_temperature_per_motor_is_read_too() -> None:
    back = changed(lambda motor: motor.update(temperature=41.5))
    np.testing.assert_array_equal(back.temperature, np.full((29, 1), 41.5))


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("temperature", "temperature"),
        ("motorstate", "faults"),
        ("lost", "lost"),
        ("mode", "enabled"),
    ],
)
def test_a_field_that_is_absent_is_not_reported_and_the_others_are(name: str, field: str) -> None:
    back = changed(lambda motor: motor.pop(name, None))
    fields = {"temperature", "faults", "lost", "enabled"}
    assert getattr(back, field) is None
    assert all(getattr(back, other) is not None for other in fields - {field})


@pytest.mark.parametrize("value", ["hot", None, [], [1, 2, 3], {}, True, 1e300, -1, 1.5])
def test_nonsense_in_an_optional_field_never_refuses_the_reading(value: object) -> None:
    back = changed(
        lambda motor: motor.update(temperature=value, motorstate=value, lost=value, mode=value)
    )
    np.testing.assert_array_equal(back.torque, FULL.torque)
    assert back.faults is None
    assert back.lost is None
    assert back.enabled is None


def test_a_temperature_that_cannot_be_one_is_unknown() -> None:
    back = changed(lambda motor: motor.update(temperature=[500.0, 43.0]))
    assert np.isnan(back.temperature[:, 0]).all()
    np.testing.assert_array_equal(back.temperature[:, 1], 43.0)


@pytest.mark.parametrize("zeros", [0.0, [0, 0]])
def test_zeros_everywhere_are_no_temperatures(zeros: object) -> None:
    assert changed(lambda motor: motor.update(temperature=zeros)).temperature is None


def test_status_bits_in_words() -> None:
    assert fault_words(0x200) == "winding overheating (0x200)"
    assert fault_words(0x201) == "overcurrent, winding overheating (0x201)"
    assert fault_words(0x100000) == "unknown (0x100000)"
