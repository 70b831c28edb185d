"""`egovcp-mcap info`: the content of a recording, and whether it is complete."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from egovcp.errors import UsageError
from egovcp.log.mcap_reader import RawTick, RecordingReader
from egovcp.log.messages import Topic
from egovcp.log.tick import RunInfo
from egovcp.outputs import STDOUT, output_file, write_report
from egovcp.rate import NS_PER_S
from egovcp.terminal import echo, echo_lines
from egovcp_deploy.mcap.history import History, history_words


@dataclass(frozen=True)
class InfoConfig:
    """Say what is in a recording: the run, its ticks and rates, its topics, what is missing,
    every change of the runner's state with its reason, maxima per joint, and whether the file is
    complete."""

    file: str = ""
    """The recording, an MCAP file."""
    json: str = output_file(or_stdout=True)
    """File for the same in JSON; `-`: print that instead."""


CONFIG = InfoConfig


@dataclass(frozen=True)
class Gap:
    """Ticks that were made but are not in the recording, or a pause."""

    after: int
    """Index of the tick before it."""
    missing: int
    """Ticks that are not there; 0 for a pause."""
    seconds: float
    """From the tick before it to the tick after it."""


@dataclass
class Summary:
    """What `egovcp-mcap info` says."""

    file: str
    bytes: int
    info: RunInfo
    complete: bool = False
    """The file has its end, and no part of it is damaged."""
    damaged: bool = False
    """A part of the file is damaged."""
    lost: str = ""
    """How many ticks the damage cost, and where; empty if nothing is damaged."""
    ticks: int = 0
    duration_s: float = 0.0
    """From the first tick to one period after the last."""
    gaps: list[Gap] = field(default_factory=list)
    events: int = 0
    """Lines in the log."""
    messages: Counter[str] = field(default_factory=Counter)
    types: dict[str, str] = field(default_factory=dict)
    history: History = field(default_factory=History)

    @property
    def missing(self) -> int:
        """Ticks that were dropped."""
        return sum(gap.missing for gap in self.gaps)

    @property
    def rate_hz(self) -> float:
        """Recorded ticks per second."""
        return self.ticks / self.duration_s if self.duration_s else 0.0

    def to_json(self) -> dict[str, Any]:
        """Keys of the report."""
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
            "last_event": self.history.ending,
            "states": [asdict(change) for change in self.history.changes],
            "joint_maxima": None if self.history.joints is None else self.history.joints.to_json(),
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


def run(config: InfoConfig) -> None:
    """Print the summary.

    Raises:
        DataError: not a recording of ours, or a damaged one; the summary is printed before.
    """
    if not config.file:
        raise UsageError("which recording? egovcp-mcap info FILE")
    reader = RecordingReader(Path(config.file))
    summary = _summarise(Path(config.file), reader)
    report = json.dumps(summary.to_json(), indent=2)
    if config.json == STDOUT:
        echo(report)
    else:
        write_report(config.json, summary.to_json())
        echo_lines(text(summary))
    reader.require_undamaged()


def summarise(path: Path) -> Summary:
    """Read the whole recording once. Depth images and plans are not decoded.

    Raises:
        DataError: not a recording of ours, or one with a damaged message.
    """
    return _summarise(path, RecordingReader(path))


def _summarise(path: Path, reader: RecordingReader) -> Summary:
    summary = Summary(str(path), path.stat().st_size, reader.info)
    period_ns = NS_PER_S // reader.info.fps
    first_ns, last = 0, None
    for raw in reader.raw_ticks():
        if last is None:
            first_ns = raw.time_ns
        elif gap := _gap(last, raw, period_ns):
            summary.gaps.append(gap)
        last = raw
        summary.ticks += 1
        summary.messages.update(raw.messages.keys())
        summary.history.add(raw)
        summary.events += len(raw.text(Topic.LOG).splitlines())
    if last is not None:
        summary.duration_s = (last.time_ns - first_ns + period_ns) / NS_PER_S
    summary.complete, summary.damaged = reader.complete, reader.damaged
    summary.lost = reader.loss_text() if reader.damaged else ""
    summary.types = {line.topic: line.schema.name for line in reader.topics.values()}
    return summary


def _gap(before: RawTick, raw: RawTick, period_ns: int) -> Gap | None:
    missing = raw.index - before.index - 1
    passed = raw.time_ns - before.time_ns
    late = passed - (missing + 1) * period_ns > period_ns / 2
    return Gap(before.index, missing, passed / NS_PER_S) if missing or late else None


def text(summary: Summary) -> list[str]:
    """Lines for reading."""
    info = summary.info
    lines = [
        f"{summary.file}: {_state(summary)}, {summary.bytes / 1e6:.1f} MB",
        f"run       {info.task}, seed {info.seed}, episode {info.episode}",
        f"ticks     {summary.ticks} in {summary.duration_s:.2f} s, {summary.rate_hz:.2f} Hz",
        f"missing   {summary.missing} ticks in {len(summary.gaps)} gaps",
        *(f"          after tick {g.after}: {_words(g)}" for g in summary.gaps[:_SHOWN_GAPS]),
        f"events    {summary.events}",
        *(f"hash      {name} {value}" for name, value in info.hashes.items()),
        f"versions  {', '.join(f'{name} {v}' for name, v in info.versions.items())}",
        *([f"planner   computed by {info.backend}"] if info.backend else []),
        *history_words(summary.history),
        "topics",
    ]
    width = max(map(len, summary.messages), default=0)
    lines += [
        f"  {topic:{width}}  {count:6d}  {summary.types[topic]}"
        for topic, count in sorted(summary.messages.items())
    ]
    if not summary.complete and not summary.damaged:  # damage ends the command with an error
        lines.append(f"save its ticks: egovcp-mcap recover {summary.file} OUT.mcap")
    return lines


def _state(summary: Summary) -> str:
    if summary.damaged:
        return f"DAMAGED, {summary.lost}"
    return "complete" if summary.complete else "TORN"


_SHOWN_GAPS = 10


def _words(gap: Gap) -> str:
    what = f"{gap.missing} missing" if gap.missing else "a pause"
    return f"{what}, {gap.seconds:.2f} s"
