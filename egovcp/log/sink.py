"""Where ticks go: one small Protocol, and a fan-out to several of them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Protocol, runtime_checkable

from egovcp.log.info import RunInfo
from egovcp.log.tick import Tick


class Sink(Protocol):
    """Takes the ticks of one run: ``open`` once, ``write`` in time order, ``close`` once."""

    def open(self, info: RunInfo) -> None:
        """Start the log with what describes the run."""
        ...

    def write(self, tick: Tick) -> None:
        """Record one tick."""
        ...

    def close(self) -> None:
        """Finish the log; it is complete on disk afterwards. Further calls do nothing."""
        ...


@runtime_checkable
class RetryingSink(Sink, Protocol):
    """A sink that keeps a tick for which there was no room, until there is."""

    def retry(self) -> None:
        """Write that tick; raises OSError if it still does not fit."""
        ...


class Fanout:
    """Writes every tick to several sinks; a sink itself."""

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = tuple(sinks)

    def open(self, info: RunInfo) -> None:
        """Open every sink."""
        for sink in self._sinks:
            sink.open(info)

    def write(self, tick: Tick) -> None:
        """Write ``tick`` to every sink."""
        for sink in self._sinks:
            sink.write(tick)

    def close(self) -> None:
        """Close every sink, even when an earlier one fails; what failed is raised."""
        with ExitStack() as stack:
            for sink in reversed(self._sinks):
                stack.callback(sink.close)
