"""The process of an `AsyncSink`: writes the ticks that arrive through a pipe to one sink.

    python -m egovcp.log.writer_process COMMANDS REPORTS     two inherited pipe descriptors

If the parent ends first, it writes what is left in the pipe, closes the sink and exits.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Final

from egovcp.errors import EgovcpError, EnvironmentFailure
from egovcp.log.pipe import WriterReport, receive
from egovcp.log.tick import Sink

NICENESS: Final = 5  # the control loop has priority on a shared core


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
        _report(reports, _picklable(error))
        with suppress(Exception):
            if sink is not None:
                sink.close()


def _report(reports: Connection, report: WriterReport) -> None:
    """Send a report; without a reader it is dropped and the log is still written."""
    with suppress(BrokenPipeError):
        reports.send(report)


def _picklable(error: Exception) -> Exception:
    """The error itself if it is an `EgovcpError` or `OSError` and can be pickled, else its text."""
    if isinstance(error, EgovcpError | OSError):
        with suppress(Exception):
            pickle.dumps(error)
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
