"""What a recording says of its run: state changes with their reasons, and maxima per joint."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.log.mcap_reader import RawTick
from egovcp.log.messages import Topic
from egovcp.log.tick import MODES, MotorReadings
from egovcp.rate import NS_PER_S
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp_deploy.robots.motor_fields import fault_words

_CHANGE: Final = re.compile(rf"({'|'.join(MODES)}) -> ({'|'.join(MODES)}): (.*)")
_NOT_RECORDED: Final = "the reason was not recorded"


@dataclass(frozen=True)
class StateChange:
    """The runner's state machine went from one state to another."""

    time_s: float
    """Since the first tick of the recording."""
    before: str
    after: str
    reason: str


@dataclass
class JointMaxima:
    """Greatest values of each joint, (29,) in ``spec.JOINT_NAMES`` order."""

    torque: NDArray[np.float64] = field(default_factory=lambda: np.zeros(NUM_JOINTS))
    """Absolute torque, N m."""
    temperature: NDArray[np.float64] | None = None
    """Of the hottest sensor, deg C; None: never reported."""
    lost: NDArray[np.int64] | None = None
    """Packets lost since the motors were switched on; None: never reported."""
    faults: NDArray[np.int64] | None = None
    """Every status bit that was ever set; None: never reported."""

    def add(self, motors: MotorReadings) -> None:
        """Take the readings of one tick."""
        self.torque = np.fmax(self.torque, np.abs(motors.torque))
        if motors.temperature is not None:
            hottest = np.fmax.reduce(motors.temperature, axis=1)
            before = self.temperature
            self.temperature = hottest if before is None else np.fmax(before, hottest)
        if motors.lost is not None:
            self.lost = np.maximum(0 if self.lost is None else self.lost, motors.lost)
        if motors.faults is not None:
            self.faults = np.bitwise_or(0 if self.faults is None else self.faults, motors.faults)

    def to_json(self) -> dict[str, dict[str, Any]]:
        """Joint -> its maxima; null: not reported."""
        return {name: self._joint(i) for i, name in enumerate(JOINT_NAMES)}

    def _joint(self, i: int) -> dict[str, Any]:
        known = self.temperature is not None and np.isfinite(self.temperature[i])
        return {
            "torque_nm": float(self.torque[i]),
            "temperature_deg_c": float(self.temperature[i]) if known else None,  # type: ignore[index]
            "lost_packets": None if self.lost is None else int(self.lost[i]),
            "faults": None if self.faults is None else int(self.faults[i]),
        }


@dataclass
class History:
    """Filled tick by tick."""

    changes: list[StateChange] = field(default_factory=list)
    joints: JointMaxima | None = None
    """None: no motor readings were recorded."""
    ending: str = ""
    """The last event of the recording; empty: there was none."""
    _mode: str = ""
    _begin_ns: int | None = None

    def add(self, raw: RawTick) -> None:
        """Take the next tick.

        Raises:
            DataError: a message is damaged.
        """
        if self._begin_ns is None:
            self._begin_ns = raw.time_ns
        lines = raw.text(Topic.LOG).splitlines()
        self._add_changes((raw.time_ns - self._begin_ns) / NS_PER_S, raw.mode(), lines)
        self.ending = lines[-1] if lines else self.ending
        motors = raw.motors()
        if motors is not None:
            self.joints = self.joints or JointMaxima()
            self.joints.add(motors)

    def _add_changes(self, time_s: float, mode: str, lines: list[str]) -> None:
        found = [match.groups() for line in lines if (match := _CHANGE.fullmatch(line))]
        self.changes += [StateChange(time_s, *groups) for groups in found]
        told = found[-1][1] if found else self._mode
        if mode and told and mode != told:
            self.changes.append(StateChange(time_s, told, mode, _NOT_RECORDED))
        self._mode = mode or told


def history_words(history: History) -> list[str]:
    """Lines for reading."""
    lines = []
    if history.changes:
        lines.append("states")
        lines += [
            f"  {c.time_s:8.2f} s  {c.before} -> {c.after}: {c.reason}" for c in history.changes
        ]
    if history.ending:
        lines.append(f"last event  {history.ending}")
    return lines + ([] if history.joints is None else _joint_table(history.joints))


def _joint_table(joints: JointMaxima) -> list[str]:
    """One line per joint: its maxima."""
    columns: dict[str, list[str]] = {
        "joint": list(JOINT_NAMES),
        "max torque": [f"{torque:.1f} N m" for torque in joints.torque],
    }
    if joints.temperature is not None:
        columns["max temperature"] = [
            f"{degrees:.0f} deg C" if np.isfinite(degrees) else "" for degrees in joints.temperature
        ]
    if joints.lost is not None:
        columns["lost packets"] = [str(lost) for lost in joints.lost]
    if joints.faults is not None:
        columns["faults"] = [fault_words(int(f)) if f else "none" for f in joints.faults]
    widths = [max(map(len, (name, *cells))) for name, cells in columns.items()]
    rows = [list(columns), *zip(*columns.values(), strict=True)]
    return [_row(row, widths) for row in rows]


def _row(cells: Any, widths: list[int]) -> str:
    padded = [f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True)]
    return "  ".join(padded).rstrip()
