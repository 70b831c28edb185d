"""`egovcp-mcap info`: the content of a recording, and whether it is complete."""

from __future__ import annotations

import json
import re
import shlex
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from egovcp.errors import DataError, UsageError
from egovcp.files import user_path
from egovcp.log.mcap_reader import RecordingReader
from egovcp.log.messages import TEMPERATURE_SENSORS, Topic
from egovcp.log.tick import MODES, MotorReadings
from egovcp.manifest import finite_or_null
from egovcp.outputs import STDOUT, output_file, require_not_input, write_report
from egovcp.rate import NS_PER_S
from egovcp.spec import JOINT_NAMES, NUM_JOINTS
from egovcp.terminal import echo, echo_lines

_MODE: Final = "|".join(MODES)
_CHANGE: Final = re.compile(rf"(?P<before>{_MODE}) -> (?P<after>{_MODE}): (?P<reason>.*)")
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


def summarise(path: Path) -> tuple[dict[str, Any], RecordingReader]:
    """The report of --json on the recording ``path``, and the reader, which has read it once; depth
    images and plans are not decoded. Raises `DataError` if it is not a recording of ours, or a
    message is damaged."""
    reader = RecordingReader(path)
    period_ns = NS_PER_S // reader.info.fps
    ticks, first_ns, last = 0, 0, None
    gaps, states, events = list[dict[str, Any]](), list[dict[str, Any]](), list[str]()
    messages = Counter[str]()  # by topic
    torque, temperature = np.full((2, NUM_JOINTS), np.nan)  # greatest values of each joint
    for raw in reader.raw_ticks():
        if last is None:
            first_ns = raw.time_ns
        else:
            missing, passed_ns = raw.index - last.index - 1, raw.time_ns - last.time_ns
            if missing or passed_ns > 1.5 * period_ns:  # without missing ticks: a pause
                seconds = passed_ns / NS_PER_S  # from the tick before it to the tick after it
                gaps.append({"after": last.index, "missing": missing, "seconds": seconds})
        ticks, last = ticks + 1, raw
        messages.update(raw.messages.keys())
        for line in raw.text(Topic.LOG).splitlines():
            events.append(line)
            if match := _CHANGE.fullmatch(line):
                states.append({"time_s": (raw.time_ns - first_ns) / NS_PER_S, **match.groupdict()})
        if (motors := raw.motors()) is not None:
            _require_joints(motors, raw.index)
            torque = np.fmax(torque, np.abs(motors.torque))
            if motors.temperature is not None:
                temperature = np.fmax(temperature, np.fmax.reduce(motors.temperature, axis=1))
    duration_s = 0.0 if last is None else (last.time_ns - first_ns + period_ns) / NS_PER_S
    joint_maxima = None
    if np.isfinite(torque).any():
        joint_maxima = {
            name: finite_or_null({"torque_nm": most, "temperature_deg_c": degrees})
            for name, most, degrees in zip(
                JOINT_NAMES, torque.tolist(), temperature.tolist(), strict=True
            )
        }
    report = {
        "file": str(path),
        "bytes": path.stat().st_size,
        "complete": reader.complete,
        "damaged": reader.damaged,
        "lost": reader.loss_text() if reader.damaged else "",
        "ticks": ticks,
        "duration_s": duration_s,  # from the first tick to one period after the last
        "rate_hz": ticks / duration_s if duration_s else 0.0,
        "missing": sum(gap["missing"] for gap in gaps),
        "gaps": gaps,
        "events": len(events),
        "last_event": events[-1] if events else "",
        "states": states,
        "joint_maxima": joint_maxima,
        "topics": {
            topic: {
                "type": reader.topics[topic].schema.name,
                "messages": count,
                "rate_hz": count / duration_s if duration_s else 0.0,
            }
            for topic, count in sorted(messages.items())
        },
        "run": asdict(reader.info),
    }
    return report, reader


def _require_joints(motors: MotorReadings, tick: int) -> None:
    """Raise `DataError` unless the readings are those of a G1's motors."""
    temperatures = None if motors.temperature is None else motors.temperature.shape
    known = (None, *((NUM_JOINTS, count) for count in TEMPERATURE_SENSORS))
    if motors.torque.shape != (NUM_JOINTS,) or temperatures not in known:
        raise DataError(
            f"tick {tick} has torques of {len(motors.torque)} joints and temperatures of shape "
            f"{temperatures}, expected {NUM_JOINTS} joints; the recording is damaged"
        )


def as_text(report: dict[str, Any]) -> list[str]:
    """The report of `summarise` as lines of text."""
    condition = "complete" if report["complete"] else "TRUNCATED"
    if report["damaged"]:
        condition = f"DAMAGED, {report['lost']}"
    run = report["run"]
    lines = [
        f"{report['file']}: {condition}, {report['bytes'] / 1e6:.1f} MB",
        f"run       {run['task'] or 'no task'}, seed {run['seed']}, episode {run['episode']}",
        f"ticks     {report['ticks']} in {report['duration_s']:.2f} s, {report['rate_hz']:.2f} Hz",
        f"missing   {report['missing']} ticks in {len(report['gaps'])} gaps",
    ]
    for gap in report["gaps"][:_SHOWN_GAPS]:
        what = f"{gap['missing']} missing" if gap["missing"] else "a pause"
        lines.append(f"          after tick {gap['after']}: {what}, {gap['seconds']:.2f} s")
    lines.append(f"events    {report['events']}")
    lines += [f"hash      {name} {value}" for name, value in run["hashes"].items()]
    lines.append(f"versions  {', '.join(f'{name} {v}' for name, v in run['versions'].items())}")
    if run["backend"]:
        lines.append(f"planner   computed by {run['backend']}")
    if report["states"]:
        lines.append("states")
    for s in report["states"]:
        lines.append(f"  {s['time_s']:8.2f} s  {s['before']} -> {s['after']}: {s['reason']}")
    if report["events"]:
        lines.append(f"last event  {report['last_event']}")
    if report["joint_maxima"]:
        width = max(map(len, JOINT_NAMES))
        lines.append(f"{'joint':{width}}  max torque  max temperature")
        for name, most in report["joint_maxima"].items():
            torque, degrees = most["torque_nm"], most["temperature_deg_c"]
            torque_text = "" if torque is None else f"{torque:6.1f} N m"
            temperature_text = "" if degrees is None else f"{degrees:.0f} deg C"
            lines.append(f"{name:{width}}  {torque_text:10}  {temperature_text}".rstrip())
    lines.append("topics")
    width = max(map(len, report["topics"]), default=0)
    for topic, each in report["topics"].items():
        lines.append(f"  {topic:{width}}  {each['messages']:6d}  {each['type']}")
    if condition == "TRUNCATED":  # damage ends the command with an error
        file = shlex.quote(report["file"])
        lines.append(f"recover its ticks: egovcp-mcap recover {file} OUT.mcap")
    return lines


def run(config: RecordingInfoConfig) -> None:
    """Print the summary; then raise `DataError` if the recording is damaged."""
    if not config.file:
        raise UsageError("no recording given; usage: egovcp-mcap info FILE")
    path = user_path(config.file)
    if config.json != STDOUT:
        require_not_input(config.json, "--json", path)
    report, reader = summarise(path)
    if config.json == STDOUT:
        echo(json.dumps(report, indent=2))
    else:
        write_report(config.json, report)
        echo_lines(as_text(report))
    reader.require_undamaged()
