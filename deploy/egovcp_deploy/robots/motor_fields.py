"""The optional fields of a motor's state on the wire, and what Unitree's status bits mean.

A field that is absent, or not what Unitree's ``MotorState_`` holds, is not reported: the checks
that need it are off, and the reading is used all the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings

#: ``motorstate``: bit -> meaning, from Unitree's developer documentation of the G1 ("Common
#: mistakes and definitions"). Untested on hardware.
MOTOR_STATUS_BITS: Final = {
    0x1: "overcurrent",
    0x2: "transient overvoltage",
    0x4: "sustained overvoltage",
    0x8: "transient undervoltage",
    0x10: "chip overheating",
    0x20: "MOSFET too hot or too cold",
    0x40: "MOSFET temperature sensor",
    0x80: "casing too hot or too cold",
    0x100: "casing temperature sensor",
    0x200: "winding overheating",
    0x400: "rotor encoder 1",
    0x800: "rotor encoder 2",
    0x1000: "output encoder",
    0x2000: "calibration data",
    0x4000: "unexpected reset",
    0x8000: "motor locked, authentication",
    0x10000: "chip validation",
    0x20000: "calibration mode",
    0x40000: "communication checksum",
    0x80000: "driver version too low",
    0x40000000: "motor lost the connection to the robot's computer",
    0x80000000: "the robot's computer lost the connection to the motor",
}
DISCONNECTED: Final = 0x80000000
_ENABLED_MODE: Final = 1
_COLDEST, _HOTTEST = -40.0, 250.0  # deg C, what a sensor of a G1's motor can report


def fault_words(bits: int) -> str:
    """What status bits mean, such as ``winding overheating (0x200)``."""
    words = [meaning for bit, meaning in MOTOR_STATUS_BITS.items() if bits & bit]
    if bits & ~sum(MOTOR_STATUS_BITS):
        words.append("unknown")
    return f"{', '.join(words)} (0x{bits:x})"


def decode_motor_fields(motors: Sequence[dict[str, Any]]) -> dict[str, NDArray[Any] | None]:
    """Optional fields of `MotorReadings` from the motors of a message; None: not reported."""
    modes = _whole([motor.get("mode") for motor in motors])
    return {
        "temperature": _temperatures([motor.get("temperature") for motor in motors]),
        "faults": _whole([motor.get("motorstate") for motor in motors]),
        "lost": _whole([motor.get("lost") for motor in motors]),
        "enabled": None if modes is None else modes == _ENABLED_MODE,
    }


def encode_motor_fields(motors: MotorReadings) -> dict[str, list[Any]]:
    """The inverse: field -> one value per motor; what is not reported is left out."""
    fields: dict[str, list[Any]] = {}
    if motors.temperature is not None:
        rows = motors.temperature.tolist()
        fields["temperature"] = [row[0] if len(row) == 1 else row for row in rows]
    if motors.faults is not None:
        fields["motorstate"] = motors.faults.tolist()
    if motors.lost is not None:
        fields["lost"] = motors.lost.tolist()
    if motors.enabled is not None:
        fields["mode"] = motors.enabled.astype(int).tolist()
    return fields


def _temperatures(values: Sequence[object]) -> NDArray[np.float64] | None:
    """(29, 1) or (29, 2) deg C, not-a-number where a value cannot be one. None if no motor reports
    any: bridges without temperatures leave the field out or fill it with zeros."""
    rows = [value if isinstance(value, list) else [value] for value in values]
    width = len(rows[0])
    if width not in (1, 2) or any(len(row) != width for row in rows):
        return None
    array = np.array([list(map(_degrees, row)) for row in rows])
    return array if np.nan_to_num(array).any() else None


def _degrees(value: object) -> float:
    if type(value) not in (int, float):
        return math.nan
    degrees = float(value) if abs(value) < 1e6 else math.nan  # type: ignore[arg-type]
    return degrees if _COLDEST <= degrees <= _HOTTEST else math.nan


def _whole(values: Sequence[object]) -> NDArray[np.int64] | None:
    """(29,) whole numbers that fit 32 bits; None if any is something else."""
    numbers = list(_unsigned(values))
    return np.array(numbers, np.int64) if len(numbers) == len(values) else None


def _unsigned(values: Sequence[object]) -> Iterator[int]:
    for value in values:
        if type(value) is int and 0 <= value < 2**32:
            yield value
