"""The other end of `BackgroundSink`: a process that writes to one sink what comes down a pipe.

    python -m egovcp.log.scribe COMMANDS REPORTS     the numbers of two inherited pipes

It outlives the process that feeds it for as long as it takes to write what lies in the pipe
and to finish the log, and then ends.
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
from egovcp.log.commands import Closed, Failed, Open, Opened, Report, Resumed, Waiting, Written
from egovcp.log.frames import Outbox, pack, receive
from egovcp.log.sink import RetryingSink, Sink
from egovcp.log.tick import Tick

NICENESS: Final = 5  # the loop comes first where both want the same core
RETRY_S: Final = 0.25  # between two looks whether a full disk has room again


def serve(commands: int, reports: int) -> None:
    """Obey the commands from one pipe and report into the other, until the first is closed."""
    outbox, run = Outbox(reports), os.getppid()
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
                        _wait_for_room(sink, lambda: os.getppid() == run)
                        _report(outbox, Resumed())
                    count += 1
                    _report(outbox, Written(count))
                case _:
                    break
        if sink is not None:
            sink.close()
        _report(outbox, Closed())
    except Exception as error:  # noqa: BLE001 - whatever it is, the run must hear of it
        _report(outbox, Failed(_portable(error)))
        with suppress(Exception):
            if sink is not None:
                sink.close()


def _is_full(error: OSError) -> bool:
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def _wait_for_room(sink: RetryingSink, wanted: Callable[[], bool]) -> None:
    """Until the disk takes the tick; raises OSError when it fails otherwise, or the run is over."""
    while True:
        time.sleep(RETRY_S)
        try:
            return sink.retry()
        except OSError as error:
            if not _is_full(error) or not wanted():
                raise


def _report(outbox: Outbox, report: Report) -> None:
    """Say it, or leave it where nobody listens: the log is worth more than its report."""
    with suppress(BrokenPipeError):
        outbox.put(pack(report))
        outbox.pump()


def _portable(error: Exception) -> Exception:
    """The error as it can be sent: ours and the system's as they are, others in words."""
    if isinstance(error, EgovcpError | OSError):
        with suppress(Exception):
            pickle.dumps(error)
            return error
    traceback.print_exception(error)
    return EnvironmentFailure(f"{type(error).__name__}: {error}")


def main() -> None:
    """Entry point of the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run answers it, and then closes the log
    with suppress(OSError):
        os.nice(NICENESS)
    serve(int(sys.argv[1]), int(sys.argv[2]))
    sys.stderr.flush()
    os._exit(0)  # a library's clean-up may wait for a viewer that hangs


if __name__ == "__main__":
    main()
