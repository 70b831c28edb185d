"""Runs cells in processes of this machine.

``python -m egovcp_experiment.local_runner MODULE [--flags]`` is the process of a cell: it calls
``MODULE.main``. Its standard input is a pipe without data. When the other end closes, because the
experiment stops or its process has died, the command is interrupted as by Ctrl-C: a training writes
its checkpoint, a collection keeps its episodes, and no process is left behind.
"""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egovcp.entry_point import INTERRUPTED
from egovcp.packages import versions_of

if TYPE_CHECKING:  # not imported in the processes of cells
    from egovcp_experiment.cell import Cell


def versions() -> dict[str, str]:
    """Versions of the packages that metrics depend on."""
    return versions_of(("egovcp", "torch", "numpy", "mujoco"))


def commit() -> str:
    """Git commit of this code, with a "+" if files of it have changed; empty if it is installed
    without a checkout."""
    folder = Path(__file__).parent

    def git(*args: str) -> str:
        command = ["git", "-C", str(folder), *args]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        return done.stdout.strip() if done.returncode == 0 else ""

    try:
        if not git("ls-files", Path(__file__).name):  # in a virtual environment
            return ""
        return git("rev-parse", "HEAD")[:12] + "+" * bool(git("diff", "HEAD"))
    except OSError:  # no git
        return ""


@cache
def machine() -> dict[str, Any]:
    """Hardware of this machine. Opens the GPU, so it is called after a command has ended."""
    from egovcp.hardware import hardware

    return {name: value for name, value in hardware().items() if name.startswith("hardware")}


class CellProcess:
    """The command of a cell in a process, which is interrupted when this process ends.

    Args:
        slot: its number among ``jobs`` processes that share the CPU cores.
    """

    def __init__(
        self, cell: Cell, argv: Sequence[str], log: Path, slot: int = 0, jobs: int = 1
    ) -> None:
        self.cell, self.argv, self.slot = cell, argv, slot
        self._start = time.monotonic()
        with log.open("ab") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__, cell.command.module, *argv],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # the scheduler handles Ctrl-C
                env=os.environ | {"PYTHONUNBUFFERED": "1"},
            )
        if jobs > 1:
            cores = sorted(os.sched_getaffinity(0))
            with suppress(OSError):  # it may have ended already
                os.sched_setaffinity(self._process.pid, cores[slot::jobs] or cores)

    @property
    def minutes(self) -> float:
        """Time since its start."""
        return (time.monotonic() - self._start) / 60.0

    def ended(self) -> int | None:
        """Its exit code, or None."""
        code = self._process.poll()
        if code is None:
            return None
        self.interrupt()  # closes the pipe
        return code

    def interrupt(self) -> None:
        """Close its standard input, which interrupts it."""
        assert self._process.stdin is not None
        self._process.stdin.close()

    def kill(self) -> None:
        """Kill it and its children."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


def _interrupt_at_end_of_input() -> None:
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGINT)


def main() -> int:
    """Entry point of a cell's process; returns the exit code of the command."""
    module, *argv = sys.argv[1:]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=_interrupt_at_end_of_input, daemon=True).start()
    sys.argv = [module, *argv]
    try:
        return int(importlib.import_module(module).main(argv))
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
