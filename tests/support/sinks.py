"""Sinks for tests: `FaultySink` stalls or raises on request, `MemorySink` keeps ticks."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from egovcp.log.tick import RunInfo, Tick


@dataclass
class FaultySink:
    """Appends a line per call to a text file; stalls or raises at given ticks."""

    path: Path
    stall_at: int = -1
    """Index of the tick at which it hangs for ``stall_s``."""
    stall_s: float = 0.0
    raise_at: int = -1
    """Index of the tick at which the disk is full."""
    close_s: float = 0.0
    """How long closing takes."""
    fail_on_close: bool = False
    """Whether the disk is full at the end of closing."""

    def open(self, info: RunInfo) -> None:
        self._note(f"open {info.task}")

    def write(self, tick: Tick) -> None:
        if tick.index == self.stall_at:
            self._note("stall")
            time.sleep(self.stall_s)
        if tick.index == self.raise_at:
            self._raise_disk_full()
        self._note(" ".join([f"tick {tick.index}", *tick.events]))

    def close(self) -> None:
        time.sleep(self.close_s)
        self._note("close")
        if self.fail_on_close:
            self._raise_disk_full()

    def _raise_disk_full(self) -> NoReturn:
        raise OSError(28, "No space left on device", str(self.path))

    def _note(self, line: str) -> None:
        with self.path.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")


class MemorySink:
    """Keeps the ticks."""

    def __init__(self) -> None:
        self.ticks: list[Tick] = []
        """In the order of writing."""

    def open(self, info: RunInfo) -> None:
        pass

    def write(self, tick: Tick) -> None:
        """Append the tick."""
        self.ticks.append(tick)

    def close(self) -> None:
        pass


class LibraryError(OSError):
    """An error as of a library; `pickle.loads` raises TypeError."""

    def __init__(self, *, reason: str) -> None:
        super().__init__(reason)


class BrokenSink(MemorySink):
    """Raises an error that cannot be sent to another process."""

    def write(self, tick: Tick) -> None:
        raise LibraryError(reason="it broke")
