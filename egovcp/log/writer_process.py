"""The process of an `AsyncSink`: writes the ticks that arrive through a pipe to one sink.

    python -m egovcp.log.writer_process COMMANDS REPORTS     two inherited pipe descriptors

The first command is the sink to open and its run, then come ticks; None closes the sink. If the
parent ends first, the process writes what is left in the pipe, closes the sink and exits.
"""

from __future__ import annotations

import fcntl
import os
import pickle
import signal
import struct
import sys
import time
import traceback
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Final

from egovcp.errors import EgovcpError, EnvironmentFailure
from egovcp.log.tick import Sink
from egovcp.workers import is_picklable

NICENESS: Final = 5  # the control loop has priority on a shared core
_PIPE_BYTES: Final = 1 << 20  # several ticks; the default of 64 KiB does not hold one
_POLL_S: Final = 0.005

type WriterReport = int | Exception | None
"""The number of ticks written, 0 when the sink is open; the error that ended the sink; or None when
the sink is closed."""


def enlarge(descriptor: int) -> None:
    """Enlarge the buffer of a pipe where the system allows it (Linux)."""
    if sys.platform.startswith("linux"):
        with suppress(OSError):
            fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)


def pack(message: object) -> bytes:
    """Serialise a message as `multiprocessing.connection.Connection` does: length and pickle."""
    content = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    return struct.pack("!i", len(content)) + content


class Outbox:
    """Queue of packed messages that are written to a pipe without blocking."""

    def __init__(self, descriptor: int) -> None:
        os.set_blocking(descriptor, False)
        self._descriptor = descriptor
        self._unsent: deque[memoryview] = deque()

    def __len__(self) -> int:
        """Number of messages that are not completely sent."""
        return len(self._unsent)

    def put(self, message: bytes) -> None:
        self._unsent.append(memoryview(message))

    def pump(self) -> None:
        """Write as many bytes as the pipe takes without blocking."""
        with suppress(BlockingIOError):
            while self._unsent:
                first = self._unsent[0]
                rest = first[os.write(self._descriptor, first) :]
                if rest:
                    self._unsent[0] = rest
                else:
                    self._unsent.popleft()


def receive(connection: Connection) -> Iterator[Any]:
    """Messages from a pipe until its writer is closed.

    It polls every few milliseconds: a blocking read would be woken by each write and preempt the
    writer on a machine with one core.
    """
    with suppress(EOFError, OSError):  # OSError: in the middle of a message
        while True:
            while not connection.poll():
                time.sleep(_POLL_S)
            yield connection.recv()


def serve(commands: Connection, reports: Connection) -> None:
    """Execute the commands of one pipe and report to the other, until the first is closed."""
    messages = receive(commands)
    sink: Sink | None = None
    try:
        if (first := next(messages, None)) is None:
            return  # the parent has ended
        sink, info = first
        sink.open(info)
        _report(reports, 0)
        for count, tick in enumerate(messages, start=1):
            if tick is None:
                break
            sink.write(tick)
            _report(reports, count)
        sink.close()
        _report(reports, None)
    except Exception as error:  # noqa: BLE001 - every error is reported to the parent
        _report(reports, _failure(error))
        with suppress(Exception):
            if sink is not None:
                sink.close()


def _report(reports: Connection, report: WriterReport) -> None:
    """Send a report; without a reader it is dropped and the log is still written."""
    with suppress(BrokenPipeError):
        reports.send(report)


def _failure(error: Exception) -> Exception:
    """The error itself if it is an `EgovcpError` or `OSError` and can be pickled, else its text."""
    if isinstance(error, EgovcpError | OSError) and is_picklable(error):
        return error
    traceback.print_exception(error)
    return EnvironmentFailure(f"{type(error).__name__}: {error}")


def main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the log ends with its pipe
    with suppress(OSError):
        os.nice(NICENESS)
    commands, reports = map(int, sys.argv[1:])
    serve(Connection(commands, writable=False), Connection(reports, readable=False))
    sys.stderr.flush()
    os._exit(0)  # a library's exit handler may wait for a viewer that hangs


if __name__ == "__main__":
    main()
