"""Cells in processes of this machine."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from egovcp.hardware import hardware
from egovcp_experiment.cell import Tool
from egovcp_experiment.runner import Ended


def machine() -> dict[str, Any]:
    """What times depend on here."""
    return {name: value for name, value in hardware().items() if name.startswith("hardware")}


class LocalProcess:
    """A command in a process of its own, which is interrupted when this one ends (`child`)."""

    def __init__(self, module: str, argv: Sequence[str], log: Path) -> None:
        with log.open("ab") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "egovcp_experiment.child", module, *argv],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is answered by the schedule
                env=os.environ | {"PYTHONUNBUFFERED": "1"},
            )

    @property
    def pid(self) -> int:
        """Its process, which leads a group."""
        return self._process.pid

    def poll(self) -> int | None:
        """Its exit code, if it has ended."""
        code = self._process.poll()
        if code is not None:
            self.interrupt()  # closes what is left of the pipe
        return code

    def wait(self, seconds: float) -> int | None:
        """`poll` after at most so long."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        return self.poll()

    def interrupt(self) -> None:
        """Close its standard input, which it takes for Ctrl-C."""
        assert self._process.stdin is not None
        self._process.stdin.close()

    def kill(self) -> None:
        """End it and all that it has started."""
        with suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self._process.wait()


class LocalRun:
    """A `LocalProcess` as a schedule sees it."""

    def __init__(self, process: LocalProcess, here: Mapping[str, Any]) -> None:
        self._process = process
        self._here = here

    def ended(self) -> Ended | None:
        """How it ended, if it has."""
        code = self._process.poll()
        return None if code is None else Ended(code, self._here)

    def interrupt(self) -> None:
        """As by Ctrl-C."""
        self._process.interrupt()

    def kill(self) -> None:
        """End it now."""
        self._process.kill()


class LocalRunner:
    """Runs at most ``jobs`` commands at a time, each on its share of the processor cores."""

    def __init__(self, jobs: int = 1) -> None:
        self._slots: list[LocalProcess | None] = [None] * jobs
        self._here = machine()

    def start(self, tool: Tool, argv: Sequence[str], log: Path) -> LocalRun:
        """Run a command at once."""
        slot = next(k for k, one in enumerate(self._slots) if one is None or one.poll() is not None)
        process = LocalProcess(tool.module, argv, log)
        _pin(process.pid, slot, len(self._slots))
        self._slots[slot] = process
        return LocalRun(process, self._here)

    def close(self) -> None:
        """Nothing is held."""


def _pin(pid: int, slot: int, jobs: int) -> None:
    """Give a process its share of the cores, where the system can."""
    if jobs == 1 or not hasattr(os, "sched_setaffinity"):
        return
    cores = sorted(os.sched_getaffinity(0))
    with suppress(OSError):  # it may have ended already
        os.sched_setaffinity(pid, cores[slot::jobs] or cores)
