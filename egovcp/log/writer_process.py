"""The process of an `AsyncSink`: writes the ticks that arrive through a pipe to one sink.

    python -m egovcp.log.writer_process COMMANDS REPORTS     two inherited pipe descriptors

If the parent ends first, it writes what is left in the pipe, closes the sink and exits.
"""

from __future__ import annotations

import errno
import os
import pickle
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from egovcp.errors import EgovcpError, EnvironmentFailure
from egovcp.log.pipe import (
    Closed,
    Failed,
    Open,
    Opened,
    Outbox,
    Resumed,
    Waiting,
    WriterReport,
    Written,
    pack,
    receive,
)
from egovcp.log.sink import RetryingSink, Sink
from egovcp.log.tick import Tick

NICENESS: Final = 5  # the control loop has priority on a shared core
RETRY_S: Final = 0.25  # between two attempts while the disk is full


def serve(commands: int, reports: int) -> None:
    """Execute the commands of one pipe and report to the other, until the first is closed."""
    outbox, parent = Outbox(reports), os.getppid()
    sink: Sink | None = None
    waits, count = False, 0
    try:
        for command in receive(commands):
            match command:
                case Open():
                    sink, waits = command.sink, command.waits
                    sink.open(command.info)
                    _report(outbox, Opened())
                case Tick() if sink is not None:
                    try:
                        sink.write(command)
                    except OSError as error:
                        if not waits or not isinstance(sink, RetryingSink) or not _is_full(error):
                            raise
                        _report(outbox, Waiting(error))
                        _wait_for_room(sink, lambda: os.getppid() == parent)
                        _report(outbox, Resumed())
                    count += 1
                    _report(outbox, Written(count))
                case _:
                    break
        if sink is not None:
            sink.close()
        _report(outbox, Closed())
    except Exception as error:  # noqa: BLE001 - every error is reported to the parent
        _report(outbox, Failed(_picklable(error)))
        with suppress(Exception):
            if sink is not None:
                sink.close()


def _is_full(error: OSError) -> bool:
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def _wait_for_room(sink: RetryingSink, parent_runs: Callable[[], bool]) -> None:
    """Retry until the disk takes the tick; raise OSError on another error or without a parent."""
    while True:
        time.sleep(RETRY_S)
        try:
            return sink.retry()
        except OSError as error:
            if not _is_full(error) or not parent_runs():
                raise


def _report(outbox: Outbox, report: WriterReport) -> None:
    """Send a report; without a reader it is dropped and the log is still written."""
    with suppress(BrokenPipeError):
        outbox.put(pack(report))
        outbox.pump()


def _picklable(error: Exception) -> Exception:
    """The error itself if it is ours or the system's and can be pickled, else its text."""
    if isinstance(error, EgovcpError | OSError):
        with suppress(Exception):
            pickle.dumps(error)
            return error
    traceback.print_exception(error)
    return EnvironmentFailure(f"{type(error).__name__}: {error}")


def main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles it and closes the log
    with suppress(OSError):
        os.nice(NICENESS)
    serve(int(sys.argv[1]), int(sys.argv[2]))
    sys.stderr.flush()
    os._exit(0)  # a library's exit handler may wait for a viewer that hangs


if __name__ == "__main__":
    main()
