"""What a `BackgroundSink` and its process say to each other."""

from __future__ import annotations

from dataclasses import dataclass

from egovcp.log.info import RunInfo
from egovcp.log.sink import Sink
from egovcp.log.tick import Tick


@dataclass(frozen=True)
class Open:
    """Begin the log."""

    sink: Sink
    info: RunInfo
    waits: bool = False
    """Whether a full disk is waited for, if the sink can; else the sink is given up."""


@dataclass(frozen=True)
class Close:
    """Finish the log; nothing follows."""


type Command = Open | Tick | Close


@dataclass(frozen=True)
class Opened:
    """The log has begun."""


@dataclass(frozen=True)
class Written:
    """So many ticks are in the log."""

    count: int


@dataclass(frozen=True)
class Waiting:
    """The disk is full; what comes waits in the pipe."""

    error: OSError


@dataclass(frozen=True)
class Resumed:
    """There is room again, and nothing of what was taken is missing."""


@dataclass(frozen=True)
class Failed:
    """The sink raised this and is given up."""

    error: Exception


@dataclass(frozen=True)
class Closed:
    """The log is finished."""


type Report = Opened | Written | Waiting | Resumed | Failed | Closed
