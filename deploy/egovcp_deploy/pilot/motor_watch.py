"""Watches the motors: heat, reported faults, and motors that no longer obey.

The result of each tick is a `MotorVerdict`: what forbids arming, what holds the robot and what
damps it. Pure: no clock and no I/O of its own.

All limits are unverified on hardware. Those with a source name it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovcp.log.tick import MotorReadings
from egovcp.rate import NS_PER_S
from egovcp.robot.g1 import EFFORT_LIMIT
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp_deploy.robots.base import LowState, MotorCommand
from egovcp_deploy.robots.wire import fault_text

Array = NDArray[np.floating]


class HeatLimits(NamedTuple):
    """Temperatures, deg C, at which to warn, to refuse to arm, and to hold."""

    warn: float
    refuse: float
    hold: float


#: `hold`: unitree_sdk2, g1/common/terminations.hpp, motor_casing_overheat. The others: 10 K each.
CASING: Final = HeatLimits(65.0, 75.0, 85.0)
#: `hold`: the same file, motor_winding_overheat. `warn`: HIGH_TEMP_ENTER of the deployment of
#: GR00T-WholeBodyControl. `refuse`: halfway.
WINDING: Final = HeatLimits(90.0, 105.0, 120.0)
#: Mean of casing and winding, as LeRobot's bridge sends it: the winding's limits with a casing of
#: 40 deg C, which is the coldest that it stays beside a hot winding.
SINGLE: Final = HeatLimits(65.0, 72.0, 80.0)

#: Status bits (`wire.MOTOR_STATUS_BITS`) that forbid to go on standing under load.
OVERLOAD_BITS: Final = 0x1 | 0x2 | 0x4 | 0x8 | 0x10 | 0x20 | 0x80 | 0x200
#: Status bits of a motor that does not know its position or is not connected: it does not obey.
DROPPED_BITS: Final = 0x400 | 0x800 | 0x1000 | 0x4000 | 0x40000000 | 0x80000000

HEAT_PERSISTS_S: Final = 0.5  # motors warm up slowly: a shorter excess is a bad reading
STATUS_PERSISTS_S: Final = 0.06  # three readings at 50 Hz
NO_TORQUE_PERSISTS_S: Final = 0.14
_MOST_ELAPSED_S: Final = 0.04  # what one reading proves, after a gap in the readings too
_COOLED_K: Final = 5.0  # below a limit before its warning is given again
_REMIND_S: Final = 10.0  # how often the operator is asked again to let the robot down
_LOST_PER_S: Final = 50.0  # packets per second of one motor, of about 500; worth a warning
#: A command that asks for more than this is large, N m: friction and the estimate's noise are
#: smaller. A torque below `_TORQUE_SHARE` of it is near zero.
LARGE_TORQUE: Final = np.maximum(1.0, 0.1 * EFFORT_LIMIT)
_TORQUE_SHARE: Final = 0.15
_LET_DOWN: Final = "let the robot down onto its crane, damp it (L1 + B) and let it cool"


@dataclass(frozen=True)
class MotorVerdict:
    """What the motors' readings ask for; empty: nothing."""

    refusal: str = ""
    """Why the robot must not be armed."""
    hold: str = ""
    """Why it must be held."""
    damp: str = ""
    """Why its motors must be damped."""
    events: tuple[str, ...] = ()
    """What is new, for the log and the operator."""


class MotorWatch:
    """Judges every reading of one robot; see the module's docstring."""

    def __init__(self) -> None:
        self._time_ns: int | None = None
        self._known: set[str] | None = None  # optional fields that were reported so far
        self._commands: tuple[MotorCommand, MotorCommand] | None = None
        self._hot = _Persistence()
        self._without_torque = _Persistence()
        self._dropped = _Persistence()
        self._was_enabled: NDArray[np.bool_] = np.zeros(NUM_JOINTS, np.bool_)
        self._torque_seen = False
        self._asked_for_torque_s = 0.0
        self._warned: NDArray[np.bool_] = np.zeros(NUM_JOINTS, np.bool_)
        self._faults: NDArray[np.integer] = np.zeros(NUM_JOINTS, np.int64)
        self._lost: tuple[int, NDArray[np.integer]] | None = None
        self._overheated = False
        self._reminded_ns: int | None = None
        self._last = MotorVerdict()

    def update(
        self, reading: LowState, command: MotorCommand | None, standing: bool = True
    ) -> MotorVerdict:
        """Judge the newest reading; the same one again changes nothing.

        Args:
            reading: of the robot's sensors.
            command: what the motors had been sent when it arrived; None: nothing.
            standing: whether the robot stands on its own, so that it can be let down.
        """
        motors = reading.motors
        if motors is None or reading.time_ns == self._time_ns:
            return MotorVerdict(self._last.refusal, self._last.hold, self._last.damp)
        elapsed = 0.0 if self._time_ns is None else (reading.time_ns - self._time_ns) / NS_PER_S
        elapsed = min(elapsed, _MOST_ELAPSED_S)
        self._time_ns = reading.time_ns
        events = self._missing_fields(motors)
        damp = self._why_damp(reading, motors, command, elapsed, events)
        hold = self._why_hold(motors, elapsed, events)
        if hold and standing and self._may_remind(reading.time_ns):
            events.append(hold)
        refusal = damp or hold or self._why_refuse(motors)
        events += self._lost_packets(motors, reading.time_ns)
        self._last = MotorVerdict(refusal, hold, damp, tuple(events))
        return self._last

    # --- what is not reported ------------------------------------------------------------
    def _missing_fields(self, motors: MotorReadings) -> list[str]:
        """Which checks are off, once, and again for a field that is no longer reported."""
        reported = {name for name in _FIELDS if getattr(motors, name) is not None}
        before, self._known = self._known, reported
        absent = _FIELDS.keys() - reported if before is None else before - reported
        gone = "not reported by the robot" if before is None else "no longer reported by the robot"
        names = ", ".join(_FIELDS[name] for name in _FIELDS if name in absent)
        events = [f"checks that are off, as they are {gone}: {names}"] if names else []
        if before is None and motors.temperature is not None and motors.temperature.shape[1] == 1:
            events.append(
                "one temperature per motor is reported, taken as the mean of casing and winding: "
                f"limits {SINGLE.warn:.0f}, {SINGLE.refuse:.0f}, {SINGLE.hold:.0f} deg C"
            )
        return events

    # --- motors that do not obey ---------------------------------------------------------
    def _why_damp(
        self,
        reading: LowState,
        motors: MotorReadings,
        command: MotorCommand | None,
        elapsed: float,
        events: list[str],
    ) -> str:
        reasons = [self._why_status(motors, elapsed)]
        if command is not None:
            reasons.append(self._why_torque(reading, motors, command, elapsed, events))
        return next(filter(None, reasons), "")

    def _why_status(self, motors: MotorReadings, elapsed: float) -> str:
        """A status that says that a motor does not obey."""
        faults = np.zeros(NUM_JOINTS, np.int64) if motors.faults is None else motors.faults
        disabled: NDArray[np.bool_] = np.zeros(NUM_JOINTS, np.bool_)
        if motors.enabled is not None:
            disabled = self._was_enabled & ~motors.enabled
            self._was_enabled = np.asarray(self._was_enabled | motors.enabled)
        joint = self._dropped.worst(
            disabled | (faults & DROPPED_BITS > 0), elapsed, STATUS_PERSISTS_S
        )
        if joint is None:
            return ""
        bits = int(faults[joint])
        what = f"it reports {fault_text(bits)}" if bits else "its mode says that it is off"
        return f"the motor of {JOINT_NAMES[joint]} does not obey: {what}"

    def _why_torque(
        self,
        reading: LowState,
        motors: MotorReadings,
        command: MotorCommand,
        elapsed: float,
        events: list[str],
    ) -> str:
        """A torque near zero although the command asks for a large one.

        A motor applies kp (q* - q) - kd dq of this command or, as commands take a moment to
        arrive, of the one before; only what both ask for counts.
        """
        before = command if self._commands is None else self._commands[1]
        self._commands = (before, command)
        now, then = _asked(command, reading), _asked(before, reading)
        asked = np.where(now * then > 0, np.minimum(np.abs(now), np.abs(then)), 0.0)
        self._listen_for_torque(motors, asked, elapsed, events)
        near_zero = np.abs(motors.torque) < _TORQUE_SHARE * asked
        silent = near_zero & (asked > LARGE_TORQUE) & self._torque_seen
        joint = self._without_torque.worst(silent, elapsed, NO_TORQUE_PERSISTS_S)
        if joint is None:
            return ""
        return (
            f"the motor of {JOINT_NAMES[joint]} does not follow its target: torque "
            f"{motors.torque[joint]:.1f} N m, {asked[joint]:.0f} N m commanded"
        )

    def _listen_for_torque(
        self, motors: MotorReadings, asked: Array, elapsed: float, events: list[str]
    ) -> None:
        """A bridge that always sends zeros estimates no torque; that is not 29 dead motors."""
        if self._torque_seen:
            return
        self._torque_seen = bool(motors.torque.any())
        was = self._asked_for_torque_s
        self._asked_for_torque_s += elapsed * bool((asked > LARGE_TORQUE).any())
        if not self._torque_seen and was <= 1.0 < self._asked_for_torque_s:
            events.append(
                "no motor reports any torque: the check for motors that do not follow is off"
            )

    # --- heat and overload ---------------------------------------------------------------
    def _why_hold(self, motors: MotorReadings, elapsed: float, events: list[str]) -> str:
        overload = self._why_overload(motors, events)
        heat = self._why_heat(motors, elapsed, events)
        reason = overload or heat
        return f"{reason}; {_LET_DOWN}" if reason else ""

    def _may_remind(self, time_ns: int) -> bool:
        due = self._reminded_ns is None or time_ns - self._reminded_ns > _REMIND_S * NS_PER_S
        if due:
            self._reminded_ns = time_ns
        return due

    def _why_overload(self, motors: MotorReadings, events: list[str]) -> str:
        if motors.faults is None:
            return ""
        for joint in np.flatnonzero(motors.faults & ~self._faults):
            bits = int(motors.faults[joint])
            events.append(f"the motor of {JOINT_NAMES[joint]} reports: {fault_text(bits)}")
        self._faults = motors.faults
        overloaded = np.flatnonzero(motors.faults & OVERLOAD_BITS)
        if not len(overloaded):
            return ""
        joint = int(overloaded[0])
        return f"the motor of {JOINT_NAMES[joint]} reports {fault_text(int(motors.faults[joint]))}"

    def _why_heat(self, motors: MotorReadings, elapsed: float, events: list[str]) -> str:
        """Held once a motor has been too hot for a while, until all are cool enough to arm."""
        if motors.temperature is None:
            was_hot = "motors were too hot and no longer report temperatures"
            return was_hot if self._overheated else ""
        beyond = margins(motors.temperature)
        joint = int(np.argmax(beyond.hold))
        if self._hot.worst(beyond.hold >= 0.0, elapsed, HEAT_PERSISTS_S) is not None:
            self._overheated = True
        self._overheated &= bool((beyond.refuse >= 0.0).any())
        self._warn(motors.temperature, beyond.warn, events)
        if not self._overheated:
            return ""
        return (
            f"the motor of {JOINT_NAMES[joint]} is too hot: {_degrees(motors.temperature[joint])}"
        )

    def _warn(self, temperature: Array, beyond: Array, events: list[str]) -> None:
        for joint in np.flatnonzero((beyond >= 0.0) & ~self._warned):
            words = _degrees(temperature[joint])
            events.append(f"warning: the motor of {JOINT_NAMES[joint]} is hot: {words}")
        self._warned = (beyond >= 0.0) | (self._warned & (beyond > -_COOLED_K))

    def _why_refuse(self, motors: MotorReadings) -> str:
        if motors.faults is not None and motors.faults.any():
            joint = int(np.flatnonzero(motors.faults)[0])
            words = fault_text(int(motors.faults[joint]))
            return f"the motor of {JOINT_NAMES[joint]} reports {words}; see Unitree's app"
        if motors.temperature is None:
            return ""
        beyond = margins(motors.temperature).refuse
        joint = int(np.argmax(beyond))
        if beyond[joint] < 0.0:
            return ""
        words = _degrees(motors.temperature[joint])
        return f"the motor of {JOINT_NAMES[joint]} is at {words}; let it cool"

    # --- lost packets --------------------------------------------------------------------
    def _lost_packets(self, motors: MotorReadings, time_ns: int) -> list[str]:
        """Once a second: motors that lose many packets."""
        if motors.lost is None:
            return []
        if self._lost is None:
            self._lost = (time_ns, motors.lost)
        since, before = self._lost
        seconds = (time_ns - since) / NS_PER_S
        if seconds < 1.0:
            return []
        self._lost = (time_ns, motors.lost)
        rates = (motors.lost - before) / seconds
        joint = int(np.argmax(rates))
        if rates[joint] < _LOST_PER_S:
            return []
        name = JOINT_NAMES[joint]
        return [f"warning: the motor of {name} loses {rates[joint]:.0f} packets per second"]


#: Optional field -> what it is.
_FIELDS: Final = {
    "temperature": "motor temperatures",
    "faults": "motor status bits",
    "lost": "packets lost by motors",
    "enabled": "motor modes",
}


_NEVER: Final = -1.0


class _Persistence:
    """How long a condition has held for each joint."""

    def __init__(self) -> None:
        self._seconds: Array = np.full(NUM_JOINTS, _NEVER)

    def worst(self, condition: NDArray[np.bool_], elapsed: float, limit: float) -> int | None:
        """Add ``elapsed`` s where it holds; the joint that it has held longest for, if that is
        ``limit`` s or more. The first reading of a condition counts from then on."""
        longer = np.where(self._seconds >= 0.0, self._seconds + elapsed, 0.0)
        self._seconds = np.where(condition, longer, _NEVER)
        joint = int(np.argmax(self._seconds))
        return joint if self._seconds[joint] >= limit - 1e-9 else None


def _asked(command: MotorCommand, reading: LowState) -> Array:
    """(29,) N m that a command asks for, within what the motors can do."""
    torque = command.stiffness * (command.position - reading.joint_position)
    torque -= command.damping * reading.joint_velocity
    return np.asarray(np.clip(torque, -EFFORT_LIMIT, EFFORT_LIMIT))


class Margins(NamedTuple):
    """(29,) K above each limit, of the sensor that is nearest to its own; negative: below."""

    warn: Array
    refuse: Array
    hold: Array


def margins(temperature: Array) -> Margins:
    """Of (29, 1) or (29, 2) temperatures; sensors that report none count as cold."""
    limits = np.array([SINGLE] if temperature.shape[1] == 1 else [CASING, WINDING])  # (k, 3)
    known = np.where(np.isfinite(temperature), temperature, -np.inf)
    beyond = (known[:, :, None] - limits).max(axis=1)  # (29, 3)
    return Margins(*beyond.T)


def hottest(motors: MotorReadings) -> str:
    """The motor that is nearest to its limit, with its temperatures; empty: none reports any."""
    if motors.temperature is None:
        return ""
    joint = int(np.argmax(margins(motors.temperature).hold))
    return f"{JOINT_NAMES[joint]}, {_degrees(motors.temperature[joint])}"


def _degrees(row: Array) -> str:
    if len(row) == 1:
        return f"{row[0]:.0f} deg C"
    named = zip(("casing", "winding"), row, strict=True)
    return ", ".join(f"{name} {value:.0f} deg C" for name, value in named if np.isfinite(value))
