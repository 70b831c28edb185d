"""Watches the motors: temperatures, reported faults, and motors that do not follow commands.

The result of each tick is a `MotorVerdict`: what forbids arming, and what requires HOLD or DAMP.
No clock and no I/O. All limits are unverified on hardware; those with a source name it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings
from egovcp.rate import NS_PER_S, RateLimiter
from egovcp.robot.g1 import EFFORT_LIMIT
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp_deploy.robots.base import LowState, MotorCommand
from egovcp_deploy.robots.wire import fault_text

Array = NDArray[np.floating]


class HeatLimits(NamedTuple):
    """Temperatures, deg C, at which to warn, to refuse arming, and to hold."""

    warn: float
    refuse: float
    hold: float


#: `hold`: unitree_sdk2, g1/common/terminations.hpp, motor_casing_overheat.
#: `refuse` and `warn` are 10 and 20 K below `hold`.
CASING: Final = HeatLimits(65.0, 75.0, 85.0)
#: `hold`: the same file, motor_winding_overheat. `warn`: HIGH_TEMP_ENTER of the deployment of
#: GR00T-WholeBodyControl. `refuse`: halfway.
WINDING: Final = HeatLimits(90.0, 105.0, 120.0)
#: Limits on the mean temperature of casing and winding, as LeRobot's bridge sends it:
#: (winding limit + 40) / 2, rounded down, where 40 deg C is the lowest casing temperature expected
#: next to a hot winding.
SINGLE: Final = HeatLimits(65.0, 72.0, 80.0)

#: Status bits (`wire.MOTOR_STATUS_BITS`) that forbid standing under load.
OVERLOAD_BITS: Final = 0x1 | 0x2 | 0x4 | 0x8 | 0x10 | 0x20 | 0x80 | 0x200
#: Status bits of a motor that has no position reading or is not connected.
DROPPED_BITS: Final = 0x400 | 0x800 | 0x1000 | 0x4000 | 0x40000000 | 0x80000000

HEAT_PERSISTS_S: Final = 0.5  # motors warm up slowly: a shorter excess is a bad reading
STATUS_PERSISTS_S: Final = 0.06  # three readings at 50 Hz
NO_TORQUE_PERSISTS_S: Final = 0.14
_MAX_ELAPSED_S: Final = 0.04  # counted for one reading, also after a gap in the readings
_HYSTERESIS_K: Final = 5.0  # below the warning limit at which the warning is re-enabled
_REMINDER_S: Final = 10.0  # between two requests to let the robot down
#: N m; a larger command exceeds friction and the noise of the torque estimate. A torque below
#: `_TORQUE_SHARE` of the command is near zero.
LARGE_TORQUE: Final = np.maximum(1.0, 0.1 * EFFORT_LIMIT)
_TORQUE_SHARE: Final = 0.15
_LET_DOWN: Final = "let the robot down onto its gantry, damp it (L1 + B) and let it cool"
#: Optional field -> description.
_FIELDS: Final = {
    "temperature": "motor temperatures",
    "faults": "motor status bits",
    "enabled": "motor modes",
}
_INACTIVE: Final = -1.0


@dataclass(frozen=True)
class MotorVerdict:
    """What the readings of the motors require; an empty reason requires nothing."""

    arming_refusal: str = ""  # why the robot must not be armed
    hold: str = ""  # why it must be held
    damp: str = ""  # why its motors must be damped
    events: tuple[str, ...] = ()  # new log lines


class MotorWatch:
    """Evaluates every reading of one robot; see the module's docstring."""

    def __init__(self) -> None:
        self._time_ns: int | None = None
        self._reported: set[str] | None = None  # optional fields of the last reading
        self._last_command: MotorCommand | None = None
        self._hot = _Debounce()
        self._without_torque = _Debounce()
        self._dropped = _Debounce()
        self._was_enabled: NDArray[np.bool_] = np.zeros(NUM_JOINTS, np.bool_)
        self._torque_seen = False
        self._warned: NDArray[np.bool_] = np.zeros(NUM_JOINTS, np.bool_)
        self._faults: NDArray[np.integer] = np.zeros(NUM_JOINTS, np.int64)
        self._overheated = False
        self._hot_sensors: NDArray[np.bool_] = np.zeros((NUM_JOINTS, 2), np.bool_)  # that set it
        self._reminder = RateLimiter(_REMINDER_S)
        self._last = MotorVerdict()
        self._events: list[str] = []

    def update(
        self, reading: LowState, command: MotorCommand | None, standing: bool = True
    ) -> MotorVerdict:
        """Evaluate the newest reading; a repeated one changes nothing. ``command`` is the last one
        sent before it arrived; ``standing``: whether the robot stands, so that it can be let down.
        """
        motors = reading.motors
        if motors is None or reading.time_ns == self._time_ns:
            return MotorVerdict(self._last.arming_refusal, self._last.hold, self._last.damp)
        elapsed = 0.0 if self._time_ns is None else (reading.time_ns - self._time_ns) / NS_PER_S
        elapsed = min(elapsed, _MAX_ELAPSED_S)
        self._time_ns = reading.time_ns
        self._events = []
        self._check_fields(motors)
        status = self._status_fault(motors, elapsed)
        torque = "" if command is None else self._torque_fault(reading, motors, command, elapsed)
        overload, heat = self._overload(motors), self._overheating(motors, elapsed)
        damp, hold = status or torque, overload or heat
        if hold:
            hold = f"{hold}; {_LET_DOWN}"
            if standing and self._reminder.ready(reading.time_ns):
                self._events.append(hold)
        refusal = damp or hold or self._arming_refusal(motors)
        self._last = MotorVerdict(refusal, hold, damp, tuple(self._events))
        return self._last

    def _check_fields(self, motors: MotorReadings) -> None:
        """Log once which checks are off, and again when a field is no longer reported."""
        reported = {name for name in _FIELDS if getattr(motors, name) is not None}
        before, self._reported = self._reported, reported
        missing = (_FIELDS.keys() if before is None else before) - reported
        since = "not reported" if before is None else "no longer reported"
        if missing:
            names = ", ".join(_FIELDS[name] for name in _FIELDS if name in missing)
            self._events.append(f"checks that are off, as they are {since} by the robot: {names}")
        if before is None and motors.temperature is not None and motors.temperature.shape[1] == 1:
            self._events.append(
                "one temperature per motor is reported, taken as the mean of casing and winding: "
                f"limits {SINGLE.warn:.0f}, {SINGLE.refuse:.0f}, {SINGLE.hold:.0f} deg C"
            )

    def _status_fault(self, motors: MotorReadings, elapsed: float) -> str:
        """A motor whose status says that it does not follow commands."""
        faults = np.zeros(NUM_JOINTS, np.int64) if motors.faults is None else motors.faults
        disabled: NDArray[np.bool_] = np.zeros(NUM_JOINTS, np.bool_)
        if motors.enabled is not None:
            disabled = self._was_enabled & ~motors.enabled
            self._was_enabled = np.asarray(self._was_enabled | motors.enabled)
        dropped = disabled | (faults & DROPPED_BITS > 0)
        joint = self._dropped.update(dropped, elapsed, STATUS_PERSISTS_S)
        if joint is None:
            return ""
        bits = int(faults[joint])
        what = f"it reports {fault_text(bits)}" if bits else "its mode is off"
        return f"the motor of {JOINT_NAMES[joint]} does not follow commands: {what}"

    def _torque_fault(
        self, reading: LowState, motors: MotorReadings, command: MotorCommand, elapsed: float
    ) -> str:
        """A torque near zero although the command requires a large one.

        A motor applies kp (q* - q) - kd dq of this command or, because of the transport delay, of
        the command before; the torque that both require is taken.
        """
        previous, self._last_command = self._last_command or command, command
        torque, previous_torque = command.torque(reading), previous.torque(reading)
        smaller = np.minimum(np.abs(torque), np.abs(previous_torque))
        expected_torque = np.where(torque * previous_torque > 0, smaller, 0.0)
        large = expected_torque > LARGE_TORQUE
        self._torque_seen |= bool(motors.torque.any())  # all zero: the bridge has no estimate
        without_torque = np.abs(motors.torque) < _TORQUE_SHARE * expected_torque
        without_torque &= large & self._torque_seen
        joint = self._without_torque.update(without_torque, elapsed, NO_TORQUE_PERSISTS_S)
        if joint is None:
            return ""
        return (
            f"the motor of {JOINT_NAMES[joint]} does not follow its target: torque "
            f"{motors.torque[joint]:.1f} N m, {expected_torque[joint]:.0f} N m commanded"
        )

    def _overload(self, motors: MotorReadings) -> str:
        if motors.faults is None:
            overloaded = np.flatnonzero(self._faults & OVERLOAD_BITS)
            lost = "; motors no longer report their status"
            return f"{_fault(self._faults, int(overloaded[0]))}{lost}" if len(overloaded) else ""
        for joint in np.flatnonzero(motors.faults & ~self._faults):
            self._events.append(_fault(motors.faults, int(joint), "reports:"))
        self._faults = motors.faults
        overloaded = np.flatnonzero(motors.faults & OVERLOAD_BITS)
        return _fault(motors.faults, int(overloaded[0])) if len(overloaded) else ""

    def _overheating(self, motors: MotorReadings, elapsed: float) -> str:
        """A motor that was too hot for `HEAT_PERSISTS_S`, until all are cool enough to arm. The
        sensors that were too hot must report so: a missing value does not count as cool."""
        if motors.temperature is None:
            lost = "motors were too hot and no longer report temperatures"
            return lost if self._overheated else ""
        warn, refuse, hold = margins(motors.temperature)
        sensors = sensor_margins(motors.temperature)
        if self._hot.update(hold >= 0.0, elapsed, HEAT_PERSISTS_S) is not None:
            self._overheated = True
            self._hot_sensors |= self._hot.lasted(HEAT_PERSISTS_S)[:, None] & (sensors[2] >= 0.0)
        cool = np.isfinite(motors.temperature) & (sensors[1] < 0.0)
        self._hot_sensors &= ~cool
        self._overheated &= bool(self._hot_sensors.any() or (refuse >= 0.0).any())
        warm = warn >= 0.0
        for joint in np.flatnonzero(warm & ~self._warned):
            words = _degrees(motors.temperature[joint])
            self._events.append(f"warning: the motor of {JOINT_NAMES[joint]} is hot: {words}")
        self._warned = warm | (self._warned & (warn > -_HYSTERESIS_K))
        if not self._overheated:
            return ""
        lost = self._hot_sensors & ~np.isfinite(motors.temperature)
        if lost.any():
            joint = int(np.argmax(lost.any(axis=1)))
            return (
                f"the motor of {JOINT_NAMES[joint]} was too hot and no longer reports a temperature"
            )
        joint = int(np.argmax(hold))
        words = _degrees(motors.temperature[joint])
        return f"the motor of {JOINT_NAMES[joint]} is too hot: {words}"

    def _arming_refusal(self, motors: MotorReadings) -> str:
        if motors.faults is not None and motors.faults.any():
            joint = int(np.flatnonzero(motors.faults)[0])
            return f"{_fault(motors.faults, joint)}; see Unitree's app"
        if motors.temperature is None:
            return ""
        _, refuse, _ = margins(motors.temperature)
        joint = int(np.argmax(refuse))
        if refuse[joint] < 0.0:
            return ""
        words = _degrees(motors.temperature[joint])
        return f"the motor of {JOINT_NAMES[joint]} is at {words}; let it cool"


class _Debounce:
    """How long a condition has held for each joint."""

    def __init__(self) -> None:
        self._seconds: Array = np.full(NUM_JOINTS, _INACTIVE)

    def update(self, condition: NDArray[np.bool_], elapsed: float, limit: float) -> int | None:
        """Add ``elapsed`` s where ``condition`` (29,) holds; returns the joint for which it has
        held longest, if that is ``limit`` s or more. The first reading where the condition holds
        counts as 0 s."""
        longer = np.where(self._seconds >= 0.0, self._seconds + elapsed, 0.0)
        self._seconds = np.where(condition, longer, _INACTIVE)
        joint = int(np.argmax(self._seconds))
        return joint if self.lasted(limit)[joint] else None

    def lasted(self, limit: float) -> NDArray[np.bool_]:
        """(29,) whether the condition has held for ``limit`` s or more."""
        return np.asarray(self._seconds >= limit - 1e-9)


def _fault(faults: NDArray[np.integer], joint: int, verb: str = "reports") -> str:
    return f"the motor of {JOINT_NAMES[joint]} {verb} {fault_text(int(faults[joint]))}"


def sensor_margins(temperature: Array) -> Array:
    """Temperatures (29, k), k = 1 or 2 -> (3, 29, k) K above the limits to warn, refuse and hold;
    negative: below. Missing values count as cold."""
    limits = np.array([SINGLE] if temperature.shape[1] == 1 else [CASING, WINDING])  # (k, 3)
    known = np.where(np.isfinite(temperature), temperature, -np.inf)
    return np.asarray(known - limits.T[:, None, :])


def margins(temperature: Array) -> tuple[Array, Array, Array]:
    """As `sensor_margins`, (29,) each, of the sensor of each motor closest to its own limit."""
    warn, refuse, hold = sensor_margins(temperature).max(axis=2)
    return warn, refuse, hold


def hottest(motors: MotorReadings) -> str:
    """The motor closest to its limit, with its temperatures; empty: none is reported."""
    if motors.temperature is None:
        return ""
    joint = int(np.argmax(margins(motors.temperature)[2]))
    return f"{JOINT_NAMES[joint]}, {_degrees(motors.temperature[joint])}"


def _degrees(row: Array) -> str:
    if len(row) == 1:
        return f"{row[0]:.0f} deg C"
    named = zip(("casing", "winding"), row, strict=True)
    return ", ".join(f"{name} {value:.0f} deg C" for name, value in named if np.isfinite(value))
