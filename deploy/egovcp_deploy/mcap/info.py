"""`egovcp-mcap info`: the content of a recording, and whether it is complete."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import UsageError
from egovcp.log.mcap_reader import RawTick, RecordingReader
from egovcp.log.messages import Topic
from egovcp.log.tick import MODES, MotorReadings, RunInfo
from egovcp.outputs import STDOUT, output_file, write_report
from egovcp.rate import NS_PER_S
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp.terminal import echo, echo_lines
from egovcp_deploy.robots.wire import fault_text

_CHANGE: Final = re.compile(rf"({'|'.join(MODES)}) -> ({'|'.join(MODES)}): (.*)")
_NOT_RECORDED: Final = "the reason was not recorded"
_SHOWN_GAPS: Final = 10


@dataclass(frozen=True)
class RecordingInfoConfig:
    """Print the content of a recording: the run, its ticks and rates, its topics, missing ticks,
    every change of the runner's state with its reason, maxima per joint, and whether the file is
    complete."""

    file: str = ""
    """The recording, an MCAP file."""
    json: str = output_file(or_stdout=True)
    """File for the same as JSON; `-`: print JSON instead."""


CONFIG = RecordingInfoConfig


@dataclass(frozen=True)
class Gap:
    """Missing ticks between two recorded ones, or a pause."""

    after: int
    """Index of the tick before it."""
    missing: int
    """Number of missing ticks; 0 for a pause."""
    seconds: float
    """From the tick before it to the tick after it."""


@dataclass(frozen=True)
class StateChange:
    """A change of the runner's state machine."""

    time_s: float
    """Since the first tick of the recording."""
    before: str
    after: str
    reason: str


@dataclass
class JointMaxima:
    """Largest values of each joint, (29,) in ``spec.JOINT_NAMES`` order."""

    torque: NDArray[np.float64] = field(default_factory=lambda: np.zeros(NUM_JOINTS))
    """Absolute torque, N m."""
    temperature: NDArray[np.float64] | None = None
    """Of the hottest sensor, deg C; None: never reported."""
    lost: NDArray[np.int64] | None = None
    """Packets lost since the motors were switched on; None: never reported."""
    faults: NDArray[np.int64] | None = None
    """Every status bit that was set at any time; None: never reported."""

    def add(self, motors: MotorReadings) -> None:
        """Add the readings of one tick."""
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

    def table(self) -> list[str]:
        """A header, and one line per joint."""
        columns: dict[str, list[str]] = {
            "joint": list(JOINT_NAMES),
            "max torque": [f"{torque:.1f} N m" for torque in self.torque],
        }
        if self.temperature is not None:
            columns["max temperature"] = [
                f"{degrees:.0f} deg C" if np.isfinite(degrees) else ""
                for degrees in self.temperature
            ]
        if self.lost is not None:
            columns["lost packets"] = [str(lost) for lost in self.lost]
        if self.faults is not None:
            columns["faults"] = [fault_text(int(f)) if f else "none" for f in self.faults]
        padded = []
        for name, cells in columns.items():
            width = max(map(len, (name, *cells)))
            padded.append([f"{cell:<{width}}" for cell in (name, *cells)])
        return ["  ".join(row).rstrip() for row in zip(*padded, strict=True)]


@dataclass
class RecordingSummary:
    """Content of a recording. `add` is called for every tick in order."""

    file: str
    bytes: int
    info: RunInfo
    complete: bool = False
    """Whether the file has its end and no part of it is damaged."""
    damaged: bool = False
    """Whether a part of the file is damaged."""
    lost: str = ""
    """How many ticks the damage cost, and where; empty if nothing is damaged."""
    ticks: int = 0
    duration_s: float = 0.0
    """From the first tick to one period after the last."""
    gaps: list[Gap] = field(default_factory=list)
    events: int = 0
    """Lines in the log."""
    last_event: str = ""
    """The last line in the log; empty: there is none."""
    changes: list[StateChange] = field(default_factory=list)
    joints: JointMaxima | None = None
    """None: no motor readings were recorded."""
    messages: Counter[str] = field(default_factory=Counter)
    types: dict[str, str] = field(default_factory=dict)
    """Topic -> message type."""
    _first_ns: int = field(default=0, init=False)
    _last: RawTick | None = field(default=None, init=False)
    _mode: str = field(default="", init=False)

    @property
    def missing(self) -> int:
        """Number of missing ticks."""
        return sum(gap.missing for gap in self.gaps)

    @property
    def rate_hz(self) -> float:
        """Recorded ticks per second."""
        return self.ticks / self.duration_s if self.duration_s else 0.0

    def add(self, raw: RawTick) -> None:
        """Add the next tick.

        Raises:
            DataError: a message is damaged.
        """
        period_ns = NS_PER_S // self.info.fps
        if self._last is None:
            self._first_ns = raw.time_ns
        else:
            missing = raw.index - self._last.index - 1
            passed = raw.time_ns - self._last.time_ns
            late = passed - (missing + 1) * period_ns > period_ns / 2
            if missing or late:
                self.gaps.append(Gap(self._last.index, missing, passed / NS_PER_S))
        self._last = raw
        self.ticks += 1
        self.duration_s = (raw.time_ns - self._first_ns + period_ns) / NS_PER_S
        self.messages.update(raw.messages.keys())
        lines = raw.text(Topic.LOG).splitlines()
        self.events += len(lines)
        self.last_event = lines[-1] if lines else self.last_event
        self._add_changes((raw.time_ns - self._first_ns) / NS_PER_S, raw.mode(), lines)
        motors = raw.motors()
        if motors is not None:
            self.joints = self.joints or JointMaxima()
            self.joints.add(motors)

    def _add_changes(self, time_s: float, mode: str, lines: list[str]) -> None:
        """The changes that the log reports, and one whose report was lost."""
        found = [match.groups() for line in lines if (match := _CHANGE.fullmatch(line))]
        self.changes += [StateChange(time_s, *groups) for groups in found]
        reported = found[-1][1] if found else self._mode
        if mode and reported and mode != reported:
            self.changes.append(StateChange(time_s, reported, mode, _NOT_RECORDED))
        self._mode = mode or reported

    def to_json(self) -> dict[str, Any]:
        """The report."""
        return {
            "file": self.file,
            "bytes": self.bytes,
            "complete": self.complete,
            "damaged": self.damaged,
            "lost": self.lost,
            "ticks": self.ticks,
            "duration_s": self.duration_s,
            "rate_hz": self.rate_hz,
            "missing": self.missing,
            "gaps": [asdict(gap) for gap in self.gaps],
            "events": self.events,
            "last_event": self.last_event,
            "states": [asdict(change) for change in self.changes],
            "joint_maxima": None if self.joints is None else self.joints.to_json(),
            "topics": {
                topic: {
                    "type": self.types[topic],
                    "messages": count,
                    "rate_hz": count / self.duration_s if self.duration_s else 0.0,
                }
                for topic, count in sorted(self.messages.items())
            },
            "run": asdict(self.info),
        }

    def to_text(self) -> list[str]:
        """The report as lines of text."""
        info = self.info
        changes = [
            f"  {c.time_s:8.2f} s  {c.before} -> {c.after}: {c.reason}" for c in self.changes
        ]
        width = max(map(len, self.messages), default=0)
        lines = [
            f"{self.file}: {self._condition()}, {self.bytes / 1e6:.1f} MB",
            f"run       {info.task}, seed {info.seed}, episode {info.episode}",
            f"ticks     {self.ticks} in {self.duration_s:.2f} s, {self.rate_hz:.2f} Hz",
            f"missing   {self.missing} ticks in {len(self.gaps)} gaps",
            *(f"          {_gap_text(gap)}" for gap in self.gaps[:_SHOWN_GAPS]),
            f"events    {self.events}",
            *(f"hash      {name} {value}" for name, value in info.hashes.items()),
            f"versions  {', '.join(f'{name} {v}' for name, v in info.versions.items())}",
            *([f"planner   computed by {info.backend}"] if info.backend else []),
            *(["states", *changes] if changes else []),
            *([f"last event  {self.last_event}"] if self.last_event else []),
            *([] if self.joints is None else self.joints.table()),
            "topics",
            *(
                f"  {topic:{width}}  {count:6d}  {self.types[topic]}"
                for topic, count in sorted(self.messages.items())
            ),
        ]
        if not self.complete and not self.damaged:  # damage ends the command with an error
            lines.append(f"recover its ticks: egovcp-mcap recover {self.file} OUT.mcap")
        return lines

    def _condition(self) -> str:
        if self.damaged:
            return f"DAMAGED, {self.lost}"
        return "complete" if self.complete else "TORN"


def _gap_text(gap: Gap) -> str:
    what = f"{gap.missing} missing" if gap.missing else "a pause"
    return f"after tick {gap.after}: {what}, {gap.seconds:.2f} s"


def run(config: RecordingInfoConfig) -> None:
    """Print the summary.

    Raises:
        DataError: not a recording of ours, or a damaged one; the summary is printed before.
    """
    if not config.file:
        raise UsageError("no recording given; usage: egovcp-mcap info FILE")
    summary, reader = _summarise(Path(config.file))
    report = summary.to_json()
    if config.json == STDOUT:
        echo(json.dumps(report, indent=2))
    else:
        write_report(config.json, report)
        echo_lines(summary.to_text())
    reader.require_undamaged()


def summarise(path: Path) -> RecordingSummary:
    """Read the whole recording once. Depth images and plans are not decoded.

    Raises:
        DataError: not a recording of ours, or one with a damaged message.
    """
    return _summarise(path)[0]


def _summarise(path: Path) -> tuple[RecordingSummary, RecordingReader]:
    reader = RecordingReader(path)
    summary = RecordingSummary(str(path), path.stat().st_size, reader.info)
    for raw in reader.raw_ticks():
        summary.add(raw)
    summary.complete, summary.damaged = reader.complete, reader.damaged
    summary.lost = reader.loss_text() if reader.damaged else ""
    summary.types = {line.topic: line.schema.name for line in reader.topics.values()}
    return summary, reader
