"""The protocol of what writes ticks, and a sink that writes to several others."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Protocol

from egovcp.log.tick import RunInfo, Tick


class Sink(Protocol):
    """Writes the ticks of one run: ``open`` once, ``write`` in time order, ``close`` once."""

    def open(self, info: RunInfo) -> None:
        """Start the log of a run."""

    def write(self, tick: Tick) -> None:
        """Write one tick."""

    def close(self) -> None:
        """Complete the log on disk; further calls do nothing."""


class Fanout:
    """A sink that writes every tick to several sinks."""

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = tuple(sinks)

    def open(self, info: RunInfo) -> None:
        for sink in self._sinks:
            sink.open(info)

    def write(self, tick: Tick) -> None:
        for sink in self._sinks:
            sink.write(tick)

    def close(self) -> None:
        """Close every sink, even if one fails; its error is raised."""
        with ExitStack() as stack:
            for sink in reversed(self._sinks):
                stack.callback(sink.close)
