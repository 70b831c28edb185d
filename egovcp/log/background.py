"""A log that never holds up the loop: ticks go to a process of their own, which writes them.

A thread would not do: encoding a tick takes milliseconds of the interpreter lock, in the middle
of a plan, and a disk that hangs holds up the exit. Here the loop only serialises the tick and
moves bytes into a pipe, as many as fit without waiting (`benchmarks/tick.py` measures both).

    loop: write(tick) -> [queue, bounded] -> pipe ~> process: sink.write(tick)

What does not fit into the queue is dropped and counted, also while the disk is full. What else
goes wrong behind the pipe (a viewer that died, a broken disk, the process killed) is told once, as
one line; the sink is then given up, and the run goes on without it.
"""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Final

from egovcp.errors import EgovcpError, EnvironmentFailure
from egovcp.log.commands import (
    Close,
    Closed,
    Failed,
    Open,
    Opened,
    Report,
    Resumed,
    Waiting,
    Written,
)
from egovcp.log.frames import Inbox, Outbox, enlarge, pack
from egovcp.log.info import RunInfo
from egovcp.log.sink import Sink
from egovcp.log.tick import Tick
from egovcp.terminal import echo

QUEUE_TICKS: Final = 300  # 12 s at 25 Hz: a disk may hang for 10 s and nothing is lost
START_TIMEOUT_S: Final = 60.0
CLOSE_TIMEOUT_S: Final = 10.0
_LAST_BREATH_S: Final = 1.0  # for a killed process to be gone; one that waits for a disk is not


def tell_on_stderr(line: str) -> None:
    """Print ``line`` to the standard error."""
    echo(line, error=True)


class BackgroundSink:
    """Writes to ``sink`` in a process of its own.

    `write` returns at once whatever happens there. `open` waits for the sink to be opened and
    raises what it raised, so that a run does not begin with a log that cannot.

    Args:
        sink: what the process opens and writes to; must be picklable before it is opened.
        name: what to call it in messages, such as ``rollout-0.mcap``.
        lossless: rather wait than drop: for a simulation in lock-step, whose time stands still.
            A full disk is not waited for, then.
        queue_ticks: ticks that may wait here.
        close_timeout_s: how long `close` waits for what is still on its way.
        tell: takes each message, one line.
    """

    def __init__(
        self,
        sink: Sink,
        name: str,
        *,
        lossless: bool = False,
        queue_ticks: int = QUEUE_TICKS,
        close_timeout_s: float = CLOSE_TIMEOUT_S,
        tell: Callable[[str], None] = tell_on_stderr,
    ) -> None:
        self._sink = sink
        self.name = name
        """What it is called in messages."""
        self._lossless = lossless
        self._capacity = queue_ticks
        self._close_timeout_s = close_timeout_s
        self._tell = tell
        self._worker: _Worker | None = None
        self._opened = self._closed = False
        self._accepted = self._written = self._gap = 0
        self._dropped = 0
        self._failure: Exception | None = None

    @property
    def dropped(self) -> int:
        """Ticks that were not taken, because the queue was full or the sink given up."""
        return self._dropped

    @property
    def lost(self) -> int:
        """Ticks that were taken, but of which it is not known that they are in the log."""
        return self._accepted - self._written

    @property
    def failure(self) -> Exception | None:
        """Why the sink was given up; None while it works."""
        return self._failure

    @property
    def pid(self) -> int:
        """Number of the process, while there is one."""
        assert self._worker is not None, "it runs from `start` to `close`"
        return self._worker.pid

    def start(self) -> None:
        """Start the process, without waiting for it; `open` does so otherwise. Several sinks
        are ready sooner when all are started before the first is opened."""
        if self._worker is None:
            self._worker = _Worker()

    def open(self, info: RunInfo) -> None:
        """Open the sink in its process, and wait for it.

        Raises:
            EgovcpError, OSError: what the sink raised.
            EnvironmentFailure: the process did not come up.
        """
        self.start()
        assert self._worker is not None
        self._worker.outbox.put(pack(Open(self._sink, info, waits=not self._lossless)))
        self._await(lambda: self._opened, START_TIMEOUT_S)
        if not self._opened:
            self.close()
            raise self._failure or EnvironmentFailure(
                f"{self.name}: the process that writes it was not ready in {START_TIMEOUT_S:.0f} s"
            )

    def write(self, tick: Tick) -> None:
        """Hand the tick over, or drop it."""
        self.take(tick, pack(tick))

    def take(self, tick: Tick, packed: bytes) -> None:
        """`write` for a tick that has been packed already."""
        worker = self._worker
        assert worker is not None, "open the sink before writing to it"
        self._pump()
        if self._lossless:
            self._await(lambda: len(worker.outbox) < self._capacity, float("inf"))
        if self._failure is not None or len(worker.outbox) >= self._capacity:
            self._drop()
            return
        worker.outbox.put(pack(self._with_gap(tick)) if self._gap else packed)
        self._accepted += 1
        self._pump()

    def close(self) -> None:
        """Finish the log, waiting no longer than ``close_timeout_s``; say what was lost."""
        if self._worker is None:
            return
        if self._opened and self._failure is None:
            self._worker.outbox.put(pack(Close()))
            self._await(lambda: self._closed, self._close_timeout_s)
        self._worker.kill()
        self._worker = None
        self._sum_up()

    def _with_gap(self, tick: Tick) -> Tick:
        """The first tick after a gap tells of it in the log."""
        gap, self._gap = self._gap, 0
        return replace(tick, events=(*tick.events, f"{gap} ticks missing: the log was too slow"))

    def _drop(self) -> None:
        self._dropped += 1
        self._gap += 1

    def _await(self, ready: Callable[[], bool], timeout_s: float) -> None:
        """Pump until ``ready``, the sink has failed, or the time is up."""
        assert self._worker is not None
        end = time.monotonic() + timeout_s
        while self._failure is None and not ready() and (left := end - time.monotonic()) > 0:
            self._worker.wait(left)
            self._pump()

    def _pump(self) -> None:
        """Move bytes both ways; never waits."""
        assert self._worker is not None
        if self._failure is not None or self._closed:
            return
        try:
            for report in self._worker.exchange():
                self._take(report)
        except (EOFError, BrokenPipeError):
            if not self._closed and self._failure is None:
                self._give_up(EnvironmentFailure(self._worker.obituary()))

    def _take(self, report: Report) -> None:
        match report:
            case Opened():
                self._opened = True
            case Written():
                self._written = report.count
            case Waiting():
                self._tell(f"{self.name}: {_words(report.error)}; ticks wait until there is room")
            case Resumed():
                self._tell(f"{self.name}: there is room again")
            case Closed():
                self._closed = True
            case Failed():
                self._give_up(report.error)

    def _give_up(self, error: Exception) -> None:
        self._failure = error
        if self._opened:  # else `open` raises it
            self._tell(f"{self.name}: {_words(error)}; the run goes on without this log")

    def _sum_up(self) -> None:
        if self._opened and (self._dropped or self.lost):
            whole = self._accepted + self._dropped
            unfinished = "" if self._closed else "; it is not finished"
            self._tell(
                f"{self.name}: {self._dropped} of {whole} ticks were dropped, "
                f"{self.lost} more may be missing at its end{unfinished}"
            )
        elif self._opened and not self._closed:
            self._tell(f"{self.name}: not finished in time; every tick is in it, its index is not")


class BackgroundFanout:
    """Several sinks, each in a process of its own: a tick is serialised once for all of them.

    A sink itself; none of the sinks can hold up another.
    """

    def __init__(self, sinks: Sequence[BackgroundSink]) -> None:
        self.sinks = tuple(sinks)

    def open(self, info: RunInfo) -> None:
        """Open every sink; raises what the first that cannot be opened raised."""
        for sink in self.sinks:
            sink.start()
        try:
            for sink in self.sinks:
                sink.open(info)
        except BaseException:
            self.close()
            raise

    def write(self, tick: Tick) -> None:
        """Hand ``tick`` to every sink."""
        packed = pack(tick)
        for sink in self.sinks:
            sink.take(tick, packed)

    def close(self) -> None:
        """Close every sink, one after the other."""
        for sink in self.sinks:
            sink.close()


class _Worker:
    """The process and the two pipes to it."""

    def __init__(self) -> None:
        theirs, self._commands = os.pipe()
        self._reports, theirs_too = os.pipe()
        enlarge(self._commands)
        self.outbox = Outbox(self._commands)
        self._inbox = Inbox(self._reports)
        os.set_blocking(self._reports, False)
        command = [sys.executable, "-m", "egovcp.log.scribe", str(theirs), str(theirs_too)]
        self._process = subprocess.Popen(
            command,
            pass_fds=(theirs, theirs_too),
            stdin=subprocess.DEVNULL,
            env=_environment(),
            start_new_session=True,  # a Ctrl-C in the terminal is not for it
        )
        os.close(theirs)
        os.close(theirs_too)

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def exchange(self) -> Iterator[Report]:
        """Send what fits into the pipe; what has come back.

        Raises:
            EOFError, BrokenPipeError: the process is gone.
        """
        broken: BrokenPipeError | None = None
        try:
            self.outbox.pump()
        except BrokenPipeError as error:
            broken = error
        yield from self._inbox.ready()  # its last words, if it is gone
        if broken is not None:
            raise broken

    def wait(self, seconds: float) -> None:
        """Until there is something to read or room to write, but no longer than ``seconds``."""
        poll = select.poll()
        poll.register(self._reports, select.POLLIN)
        if len(self.outbox):
            poll.register(self._commands, select.POLLOUT)
        poll.poll(min(seconds, 1.0) * 1e3)

    def obituary(self) -> str:
        """How the process ended."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_LAST_BREATH_S)
        code = self._process.poll()
        how = f"by signal {-code}" if code is not None and code < 0 else f"with code {code}"
        return f"the process that writes it ended {how}"

    def kill(self) -> None:
        """End it if it has not ended by itself."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0.05)
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_LAST_BREATH_S)
        for descriptor in (self._commands, self._reports):
            os.close(descriptor)


def _environment() -> dict[str, str]:
    """The same modules; quiet, since what goes wrong is reported through the pipe."""
    modules = os.pathsep.join(path for path in sys.path if path)
    return {"RUST_LOG": "off"} | os.environ | {"PYTHONPATH": modules}


def _words(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) if isinstance(error, EgovcpError) else f"{type(error).__name__}: {error}"
