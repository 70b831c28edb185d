"""Messages between an `AsyncSink` and its writer process, through non-blocking pipes.

A message on the wire is its length (u32, little endian) and its pickle.
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
from dataclasses import dataclass
from typing import Any, Final

from egovcp.log.sink import Sink
from egovcp.log.tick import RunInfo, Tick

_LENGTH: Final = struct.Struct("<I")
_PIPE_BYTES: Final = 1 << 20  # several ticks; the default of 64 KiB does not hold one
_READ_BYTES: Final = 1 << 20
_POLL_S: Final = 0.005
_MAX_PARTS: Final = 64  # of one system call


# --- commands ---------------------------------------------------------------------
@dataclass(frozen=True)
class Open:
    """Open the sink."""

    sink: Sink
    info: RunInfo
    waits: bool = False
    """Wait while the disk is full, if the sink can retry; otherwise a full disk is an error."""


@dataclass(frozen=True)
class Close:
    """Close the sink; the last command."""


type Command = Open | Tick | Close


# --- reports ----------------------------------------------------------------------
@dataclass(frozen=True)
class Opened:
    """The sink is open."""


@dataclass(frozen=True)
class Written:
    """Total number of ticks written."""

    count: int


@dataclass(frozen=True)
class Waiting:
    """The disk is full; further ticks wait in the pipe."""

    error: OSError


@dataclass(frozen=True)
class Resumed:
    """The disk has room again; no accepted tick was lost."""


@dataclass(frozen=True)
class Failed:
    """The sink raised this error and is not used any more."""

    error: Exception


@dataclass(frozen=True)
class Closed:
    """The sink is closed."""


type WriterReport = Opened | Written | Waiting | Resumed | Failed | Closed


# --- transport --------------------------------------------------------------------
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
        """Write as many bytes as the pipe takes without blocking.

        Raises:
            BrokenPipeError: the reader is closed.
        """
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


class Inbox:
    """Reads messages from a pipe."""

    def __init__(self, descriptor: int) -> None:
        os.set_blocking(descriptor, False)
        self._descriptor = descriptor
        self._buffer = bytearray()

    def ready(self) -> Iterator[Any]:
        """The messages that have arrived; does not block.

        Raises:
            EOFError: the writer is closed and all messages have been returned.
        """
        yield from self._complete()
        with suppress(BlockingIOError):
            while True:
                data = os.read(self._descriptor, _READ_BYTES)
                if not data:
                    raise EOFError
                self._buffer += data
                yield from self._complete()

    def _complete(self) -> Iterator[Any]:
        while len(self._buffer) >= _LENGTH.size:
            end = _LENGTH.size + _LENGTH.unpack_from(self._buffer)[0]
            if len(self._buffer) < end:
                return
            message = bytes(self._buffer[_LENGTH.size : end])
            del self._buffer[:end]
            yield pickle.loads(message)  # noqa: S301 - from the other end of our own pipe


def receive(descriptor: int) -> Iterator[Any]:
    """Messages from a pipe until its writer is closed.

    It polls every few milliseconds: a blocking read would be woken by each write and preempt the
    writer on a machine with one core.
    """
    inbox = Inbox(descriptor)
    with suppress(EOFError):
        while True:
            yield from inbox.ready()
            time.sleep(_POLL_S)
