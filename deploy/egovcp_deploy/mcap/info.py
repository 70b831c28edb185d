"""`egovcp-mcap info`: the content of a recording, and whether it is complete."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egovcp.errors import UsageError
from egovcp.log.mcap_reader import RawTick, RecordingReader
from egovcp.log.messages import Topic
from egovcp.log.tick import MODES, MotorReadings
from egovcp.outputs import STDOUT, output_file, write_report
from egovcp.rate import NS_PER_S
from egovcp.spec import JOINT_NAMES
from egovcp.terminal import echo, echo_lines

_CHANGE: Final = re.compile(rf"({'|'.join(MODES)}) -> ({'|'.join(MODES)}): (.*)")
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


class Gap(NamedTuple):
    """Missing ticks between two recorded ones, or a pause."""

    after: int  # index of the tick before it
    missing: int  # number of missing ticks; 0 for a pause
    seconds: float  # from the tick before it to the tick after it

    def __str__(self) -> str:
        what = f"{self.missing} missing" if self.missing else "a pause"
        return f"after tick {self.after}: {what}, {self.seconds:.2f} s"


class StateChange(NamedTuple):
    """A change of the runner's state machine."""

    time_s: float  # since the first tick of the recording
    before: str
    after: str
    reason: str

    def __str__(self) -> str:
        return f"{self.time_s:8.2f} s  {self.before} -> {self.after}: {self.reason}"


class RecordingSummary:
    """Content of the recording ``path``, which is read once; depth images and plans are not
    decoded. Raises `DataError` if it is not a recording of ours, or a message is damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.reader = RecordingReader(path)
        self.ticks = 0
        self.duration_s = 0.0  # from the first tick to one period after the last
        self.gaps: list[Gap] = []
        self.events: list[str] = []  # lines in the log
        self.changes: list[StateChange] = []
        self.messages: Counter[str] = Counter()  # topic -> number
        self.torque: NDArray[np.floating] | None = None  # (29,) N m, greatest absolute values
        self.temperature: NDArray[np.floating] | None = None  # (29,) deg C, of the hottest sensor
        first_ns, last = 0, None
        for raw in self.reader.raw_ticks():
            first_ns = raw.time_ns if last is None else first_ns
            self._add(raw, raw.time_ns - first_ns, last)
            last = raw

    def _add(self, raw: RawTick, elapsed_ns: int, last: RawTick | None) -> None:
        period_ns = NS_PER_S // self.reader.info.fps
        if last is not None:
            missing = raw.index - last.index - 1
            passed = raw.time_ns - last.time_ns
            if missing or passed > 1.5 * period_ns:
                self.gaps.append(Gap(last.index, missing, passed / NS_PER_S))
        self.ticks += 1
        self.duration_s = (elapsed_ns + period_ns) / NS_PER_S
        self.messages.update(raw.messages.keys())
        lines = raw.text(Topic.LOG).splitlines()
        self.events += lines
        found = [match.groups() for line in lines if (match := _CHANGE.fullmatch(line))]
        self.changes += [StateChange(elapsed_ns / NS_PER_S, *groups) for groups in found]
        if (motors := raw.motors()) is not None:
            self._add_maxima(motors)

    def _add_maxima(self, motors: MotorReadings) -> None:
        torque = np.abs(motors.torque)
        self.torque = torque if self.torque is None else np.fmax(self.torque, torque)
        if motors.temperature is not None:
            hottest = np.fmax.reduce(motors.temperature, axis=1)
            before = self.temperature
            self.temperature = hottest if before is None else np.fmax(before, hottest)

    @property
    def missing(self) -> int:
        """Number of missing ticks."""
        return sum(gap.missing for gap in self.gaps)

    @property
    def rate_hz(self) -> float:
        """Recorded ticks per second."""
        return self.ticks / self.duration_s if self.duration_s else 0.0

    def to_json(self) -> dict[str, Any]:
        """The report."""
        reader, seconds = self.reader, self.duration_s
        return {
            "file": str(self.path),
            "bytes": self.path.stat().st_size,
            "complete": reader.complete,
            "damaged": reader.damaged,
            "lost": reader.loss_text() if reader.damaged else "",
            "ticks": self.ticks,
            "duration_s": seconds,
            "rate_hz": self.rate_hz,
            "missing": self.missing,
            "gaps": [gap._asdict() for gap in self.gaps],
            "events": len(self.events),
            "last_event": self.events[-1] if self.events else "",
            "states": [change._asdict() for change in self.changes],
            "joint_maxima": self._joint_maxima(),
            "topics": {
                topic: {
                    "type": reader.topics[topic].schema.name,
                    "messages": count,
                    "rate_hz": count / seconds if seconds else 0.0,
                }
                for topic, count in sorted(self.messages.items())
            },
            "run": asdict(reader.info),
        }

    def _joint_maxima(self) -> dict[str, dict[str, float | None]] | None:
        """Joint -> its maxima; None: no motor readings were recorded."""
        if self.torque is None:
            return None
        heat = np.full(len(self.torque), np.nan) if self.temperature is None else self.temperature
        return {
            name: {
                "torque_nm": float(torque),
                "temperature_deg_c": float(degrees) if np.isfinite(degrees) else None,
            }
            for name, torque, degrees in zip(JOINT_NAMES, self.torque, heat, strict=True)
        }

    def to_text(self) -> list[str]:
        """The report as lines of text."""
        report, info = self.to_json(), self.reader.info
        condition = "complete" if report["complete"] else "TORN"
        if report["damaged"]:
            condition = f"DAMAGED, {report['lost']}"
        width = max(map(len, self.messages), default=0)
        lines = [
            f"{self.path}: {condition}, {report['bytes'] / 1e6:.1f} MB",
            f"run       {info.task}, seed {info.seed}, episode {info.episode}",
            f"ticks     {self.ticks} in {self.duration_s:.2f} s, {self.rate_hz:.2f} Hz",
            f"missing   {self.missing} ticks in {len(self.gaps)} gaps",
            *(f"          {gap}" for gap in self.gaps[:_SHOWN_GAPS]),
            f"events    {len(self.events)}",
            *(f"hash      {name} {value}" for name, value in info.hashes.items()),
            f"versions  {', '.join(f'{name} {v}' for name, v in info.versions.items())}",
            *([f"planner   computed by {info.backend}"] if info.backend else []),
            *(["states"] if self.changes else []),
            *(f"  {change}" for change in self.changes),
            *([f"last event  {report['last_event']}"] if self.events else []),
            *_table(report["joint_maxima"] or {}),
            "topics",
            *(
                f"  {topic:{width}}  {each['messages']:6d}  {each['type']}"
                for topic, each in report["topics"].items()
            ),
        ]
        if condition == "TORN":  # damage ends the command with an error
            lines.append(f"recover its ticks: egovcp-mcap recover {self.path} OUT.mcap")
        return lines


def _table(maxima: dict[str, dict[str, float | None]]) -> list[str]:
    """A header, and one line per joint."""
    width = max(map(len, JOINT_NAMES))
    rows = [f"{'joint':{width}}  max torque  max temperature"]
    for name, most in maxima.items():
        degrees = most["temperature_deg_c"]
        heat = "" if degrees is None else f"{degrees:.0f} deg C"
        rows.append(f"{name:{width}}  {most['torque_nm']:6.1f} N m  {heat}".rstrip())
    return rows if maxima else []


def run(config: RecordingInfoConfig) -> None:
    """Print the summary; then raise `DataError` if the recording is damaged."""
    if not config.file:
        raise UsageError("no recording given; usage: egovcp-mcap info FILE")
    summary = RecordingSummary(Path(config.file))
    if config.json == STDOUT:
        echo(json.dumps(summary.to_json(), indent=2))
    else:
        write_report(config.json, summary.to_json())
        echo_lines(summary.to_text())
    summary.reader.require_undamaged()
