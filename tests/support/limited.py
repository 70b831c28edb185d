"""Run a command's ``main`` in a forked child with limits on memory and time.

For tests that give damaged files to a command: fork costs milliseconds, where a new interpreter
would import everything again.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NoReturn

_KILOBYTE: Final = 1024
_CRASHED: Final = 70  # EX_SOFTWARE: an exception left the function


@dataclass(frozen=True)
class LimitedResult:
    """How the child ended."""

    exit_code: int
    """Return value of the function; the negative signal number if a signal ended it."""
    output: str
    """stdout and stderr together, undecodable bytes as backslash escapes."""
    seconds: float
    """Wall time, less the time in which the child waited for a processor that others used."""
    memory_bytes: int
    """Peak resident memory beyond what the child had right after the fork."""
    timed_out: bool

    @property
    def has_traceback(self) -> bool:
        """Whether a Python traceback was printed."""
        return "Traceback (most recent call last)" in self.output


def run_limited(
    function: Callable[[], int],
    seconds: float = 5.0,
    memory_bytes: int = 2 << 30,
    network: bool = False,
) -> LimitedResult:
    """Call ``function`` in a forked child and return how it ended.

    Args:
        function: what to run, such as ``lambda: main(["check", str(root)])``.
        seconds: the child is killed after this time, not counting time in which it was ready to
            run but other processes used the processors.
        memory_bytes: private writable memory that it may allocate beyond what it inherits.
        network: without it, opening a connection raises in the child, and the result has exit
            code 70 and a traceback.
    """
    readable, writable = os.pipe()
    with tempfile.TemporaryFile() as log, os.fdopen(readable) as at_start:
        started = time.monotonic()
        pid = os.fork()
        if pid == 0:
            _run_child(function, log.fileno(), writable, memory_bytes, network)
        os.close(writable)
        elapsed, timed_out = _wait(pid, started, seconds)
        if timed_out:
            os.kill(pid, signal.SIGKILL)
        _, status, usage = os.wait4(pid, 0)
        before = int(at_start.read() or 0)
        log.seek(0)
        output = log.read().decode("utf-8", errors="backslashreplace")
    return LimitedResult(
        exit_code=os.waitstatus_to_exitcode(status),
        output=output,
        seconds=elapsed,
        memory_bytes=max(0, usage.ru_maxrss * _KILOBYTE - before),
        timed_out=timed_out,
    )


def _wait(pid: int, started: float, limit: float) -> tuple[float, bool]:
    """Wait for a child; its time in seconds, and whether that exceeded the limit."""
    descriptor = os.pidfd_open(pid)
    try:
        while True:
            elapsed = time.monotonic() - started - _queued_seconds(pid)
            remaining = max(limit - elapsed, 0.0)
            if select.select([descriptor], [], [], remaining)[0]:
                return time.monotonic() - started - _queued_seconds(pid), False
            if remaining == 0.0:
                return elapsed, True
    finally:
        os.close(descriptor)


def _queued_seconds(pid: int) -> float:
    """How long the main thread of a process, which may have ended, waited for a processor; 0 where
    the kernel does not count it."""
    try:
        _, queued_ns, _ = Path(f"/proc/{pid}/schedstat").read_text(encoding="utf-8").split()
    except FileNotFoundError:
        return 0.0
    return int(queued_ns) / 1e9


def _run_child(
    function: Callable[[], int], log: int, at_start: int, memory_bytes: int, network: bool
) -> NoReturn:
    """Never returns: whatever happens, the child ends here and not in the test runner."""
    code = _CRASHED
    try:
        os.write(at_start, str(_status_bytes("VmRSS")).encode())  # less than the parent's
        os.close(at_start)
        os.dup2(log, 1)
        os.dup2(log, 2)
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", buffering=1, closefd=False)
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", buffering=1, closefd=False)
        allowed = _status_bytes("VmData") + memory_bytes
        resource.setrlimit(resource.RLIMIT_DATA, (allowed, allowed))
        if not network:
            socket.socket.connect = _refuse_connection  # type: ignore[method-assign,assignment]
        code = function()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:  # noqa: BLE001 (the child must not return into the test runner)
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code if 0 <= code < 256 else _CRASHED)


def _refuse_connection(self: socket.socket, address: Any) -> NoReturn:
    print(f"Traceback (most recent call last): connection to {address}", file=sys.stderr)
    os._exit(_CRASHED)


def _status_bytes(name: str) -> int:
    """A figure of ``/proc/self/status``."""
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) * _KILOBYTE
    raise OSError(f"/proc/self/status has no {name}")
