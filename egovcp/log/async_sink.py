"""A sink that never blocks the control loop: a separate process writes the ticks.

    write(tick) -> bounded queue -> pipe -> writer process: sink.write(tick)

A thread would not do: encoding a tick holds the interpreter lock for milliseconds, and a disk that
hangs would block the exit. The loop only pickles the tick and writes to a non-blocking pipe
(`benchmarks/tick_logging.py` measures both).

A tick that does not fit into the queue is dropped and counted. A failure of the writer (a closed
viewer, a full disk, a killed process) is reported once, as one line; the sink then ignores further
ticks and the run continues.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Final

from egovcp.errors import EgovcpError, EnvironmentFailure
from egovcp.log.tick import Fanout, RunInfo, Sink, Tick
from egovcp.log.writer_process import Outbox, WriterReport, enlarge, pack
from egovcp.terminal import echo

QUEUE_TICKS: Final = 300  # 12 s at 25 Hz: a disk may hang for 10 s without loss
START_TIMEOUT_S: Final = 60.0
CLOSE_TIMEOUT_S: Final = 10.0
_KILL_TIMEOUT_S: Final = 1.0  # a process that waits for a disk does not end on SIGKILL
_EXIT_CODE_TIMEOUT_S: Final = 1.0  # from the end of the pipe to that of the process


def warn_on_stderr(line: str) -> None:
    echo(line, error=True)


class AsyncSink:
    """Writes to ``sink`` in a separate process.

    `write` always returns at once. `open` waits until the sink is open and raises its errors, so
    that a run does not start with a log that cannot be written.

    Args:
        sink: must be picklable before it is opened.
        name: its name in messages, such as ``rollout-0.mcap``.
        queue_ticks: capacity of the queue in this process.
        close_timeout_s: how long `close` waits for queued ticks.
        warn: receives each message, one line.
    """

    def __init__(
        self,
        sink: Sink,
        name: str,
        *,
        queue_ticks: int = QUEUE_TICKS,
        close_timeout_s: float = CLOSE_TIMEOUT_S,
        warn: Callable[[str], None] = warn_on_stderr,
    ) -> None:
        self._sink, self.name = sink, name
        self._capacity = queue_ticks
        self._close_timeout_s, self._warn = close_timeout_s, warn
        self._process: _WriterProcess | None = None
        self._opened = self._closed = False
        self._accepted = self._written = self._gap = 0
        self.dropped = 0
        """Number of ticks dropped because the queue was full or the sink had failed."""
        self.failure: Exception | None = None
        """The error of the sink; None while it works."""

    @property
    def lost(self) -> int:
        """Number of accepted ticks without a confirmation that they were written."""
        return self._accepted - self._written

    @property
    def pid(self) -> int:
        """Process id of the writer, from `start` to `close`."""
        assert self._process is not None, "it runs from `start` to `close`"
        return self._process.pid

    def start(self) -> None:
        """Start the process without waiting for it. `open` calls this; starting several sinks
        before opening the first saves time."""
        if self._process is None:
            self._process = _WriterProcess()

    def open(self, info: RunInfo) -> None:
        """Open the sink in its process, and wait for it; raises its error."""
        self.start()
        assert self._process is not None
        self._process.outbox.put(pack((self._sink, info)))
        self._await(lambda: self._opened, START_TIMEOUT_S)
        if not self._opened:
            self.close()
            raise self.failure or EnvironmentFailure(
                f"{self.name}: its writer process was not ready in {START_TIMEOUT_S:.0f} s"
            )

    def write(self, tick: Tick) -> None:
        """Queue the tick, or drop it."""
        self.write_packed(tick, pack(tick))

    def write_packed(self, tick: Tick, packed: bytes) -> None:
        process = self._process
        assert process is not None, "open the sink before writing to it"
        self._pump()
        if self.failure is not None or len(process.outbox) >= self._capacity:
            self.dropped += 1
            self._gap += 1
            return
        process.outbox.put(pack(self._with_gap(tick)) if self._gap else packed)
        self._accepted += 1
        self._pump()

    def close(self) -> None:
        """Close the sink, waiting at most ``close_timeout_s``; report lost ticks."""
        if self._process is None:
            return
        if self._opened and self.failure is None:
            self._process.outbox.put(pack(None))
            self._await(lambda: self._closed, self._close_timeout_s)
        self._process.kill()
        self._process = None
        self._report_losses()

    def _with_gap(self, tick: Tick) -> Tick:
        """The first tick after a gap, with an event that says how many were dropped."""
        gap, self._gap = self._gap, 0
        return replace(tick, events=(*tick.events, f"{gap} ticks missing: the log was too slow"))

    def _await(self, ready: Callable[[], bool], timeout_s: float) -> None:
        """Pump until ``ready``, a failure, or the timeout."""
        assert self._process is not None
        end = time.monotonic() + timeout_s
        while self.failure is None and not ready() and (left := end - time.monotonic()) > 0:
            self._process.wait(left)
            self._pump(_EXIT_CODE_TIMEOUT_S)

    def _pump(self, exit_wait_s: float = 0.0) -> None:
        """Exchange bytes with the process without blocking; if it has closed a pipe, wait at most
        ``exit_wait_s`` for its exit code."""
        assert self._process is not None
        if self.failure is not None or self._closed:
            return
        try:
            for report in self._process.exchange():
                self._handle(report)
        except (EOFError, BrokenPipeError):
            if not self._closed and self.failure is None:
                self._fail(EnvironmentFailure(self._process.exit_text(exit_wait_s)))

    def _handle(self, report: WriterReport) -> None:
        match report:
            case None:
                self._closed = True
            case int():
                self._opened, self._written = True, report
            case Exception():
                self._fail(report)

    def _fail(self, error: Exception) -> None:
        self.failure = error
        if self._opened:  # otherwise `open` raises it
            self._warn(f"{self.name}: {_text(error)}; the run continues without this log")

    def _report_losses(self) -> None:
        if self._opened and (self.dropped or self.lost):
            total = self._accepted + self.dropped
            unfinished = "" if self._closed else "; it is not finished"
            self._warn(
                f"{self.name}: {self.dropped} of {total} ticks were dropped, "
                f"{self.lost} more may be missing at its end{unfinished}"
            )
        elif self._opened and not self._closed:
            self._warn(
                f"{self.name}: not finished within {self._close_timeout_s:g} s; it is incomplete"
            )


class AsyncFanout(Fanout[AsyncSink]):
    """A sink that writes to several `AsyncSink`; a tick is serialised once for all of them."""

    def open(self, info: RunInfo) -> None:
        """Open every sink; if one fails, close all and raise its error."""
        for sink in self.sinks:
            sink.start()
        try:
            super().open(info)
        except BaseException:
            self.close()
            raise

    def write(self, tick: Tick) -> None:
        """Queue ``tick`` for every sink."""
        packed = pack(tick)
        for sink in self.sinks:
            sink.write_packed(tick, packed)


class _WriterProcess:
    """The process and the two pipes to it."""

    def __init__(self) -> None:
        theirs, self._commands = os.pipe()
        reports, theirs_too = os.pipe()
        enlarge(self._commands)
        self.outbox = Outbox(self._commands)
        self._reports = Connection(reports, writable=False)
        command = [sys.executable, "-m", "egovcp.log.writer_process", str(theirs), str(theirs_too)]
        modules = os.pathsep.join(path for path in sys.path if path)
        self._process = subprocess.Popen(
            command,
            pass_fds=(theirs, theirs_too),
            stdin=subprocess.DEVNULL,
            # Rerun stays quiet: errors are reported through the pipe
            env={"RUST_LOG": "off"} | os.environ | {"PYTHONPATH": modules},
            start_new_session=True,  # Ctrl-C in the terminal does not reach it
        )
        os.close(theirs)
        os.close(theirs_too)

    @property
    def pid(self) -> int:
        return self._process.pid

    def exchange(self) -> Iterator[WriterReport]:
        """Send what fits into the pipe; yield the reports that have arrived.

        Raises:
            EOFError, BrokenPipeError: the process has ended.
        """
        broken: BrokenPipeError | None = None
        try:
            self.outbox.pump()
        except BrokenPipeError as error:
            broken = error
        while self._reports.poll():  # includes the last reports of a process that has ended
            yield self._reports.recv()
        if broken is not None:
            raise broken

    def wait(self, seconds: float) -> None:
        poll = select.poll()
        poll.register(self._reports.fileno(), select.POLLIN)
        if len(self.outbox):
            poll.register(self._commands, select.POLLOUT)
        poll.poll(min(seconds, 1.0) * 1e3)

    def exit_text(self, wait_s: float) -> str:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(wait_s)
        code = self._process.poll()
        if code is None:
            return "its writer process closed the pipe"
        how = f"by signal {-code}" if code < 0 else f"with code {code}"
        return f"its writer process ended {how}"

    def kill(self) -> None:
        """Kill the process unless it has ended, and close the pipes."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0.05)
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_KILL_TIMEOUT_S)
        os.close(self._commands)
        self._reports.close()


def _text(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) if isinstance(error, EgovcpError) else f"{type(error).__name__}: {error}"
