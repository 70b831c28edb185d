"""Messages between an `AsyncSink` and its writer process, through pipes.

On the wire they have the format of `multiprocessing.connection.Connection`, which reads them: the
length and the pickle.
"""

from __future__ import annotations

import fcntl
import os
import pickle
import struct
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Final

from egovcp.log.tick import RunInfo, Sink, Tick

_LENGTH: Final = struct.Struct("!i")
_PIPE_BYTES: Final = 1 << 20  # several ticks; the default of 64 KiB does not hold one
_POLL_S: Final = 0.005
_MAX_PARTS: Final = 64  # of one system call


type Command = tuple[Sink, RunInfo] | Tick | None
"""First the sink to open and its run, then ticks; None closes the sink."""

type WriterReport = int | Exception | None
"""The number of ticks written, 0 when the sink is open; the error that ended the sink; or None when
the sink is closed."""


def enlarge(descriptor: int) -> None:
    """Enlarge the buffer of a pipe where the system allows it (Linux)."""
    if sys.platform.startswith("linux"):
        with suppress(OSError):
            fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)


def pack(message: object) -> bytes:
    """Serialise a message; later changes to its content do not affect the bytes."""
    return pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)


class Outbox:
    """Queue of messages that are written to a pipe without blocking."""

    def __init__(self, descriptor: int) -> None:
        os.set_blocking(descriptor, False)
        self._descriptor = descriptor
        self._parts: deque[memoryview] = deque()
        self._messages: deque[int] = deque()  # number of unsent parts of each message

    def __len__(self) -> int:
        """Number of messages that are not completely sent."""
        return len(self._messages)

    def put(self, data: bytes) -> None:
        """Append a message that `pack` has serialised."""
        self._parts += [memoryview(_LENGTH.pack(len(data))), memoryview(data)]
        self._messages.append(2)

    def pump(self) -> None:
        """Write as many bytes as the pipe takes without blocking."""
        with suppress(BlockingIOError):
            while self._parts:
                some = [self._parts[i] for i in range(min(len(self._parts), _MAX_PARTS))]
                self._sent(os.writev(self._descriptor, some))

    def _sent(self, count: int) -> None:
        while count:
            first = self._parts[0]
            if count < len(first):
                self._parts[0] = first[count:]
                return
            count -= len(first)
            self._parts.popleft()
            self._messages[0] -= 1
            if not self._messages[0]:
                self._messages.popleft()


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
