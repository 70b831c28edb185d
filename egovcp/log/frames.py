"""Messages through a pipe in pieces, as many bytes at a time as it takes without waiting."""

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
from typing import Any, Final

_LENGTH: Final = struct.Struct("<I")
_PIPE_BYTES: Final = 1 << 20  # room for several ticks; 64 KiB, the usual, does not hold one
_READ_BYTES: Final = 1 << 20
_LOOK_EVERY_S: Final = 0.005
_MOST_PARTS: Final = 64  # of one system call


def enlarge(descriptor: int) -> None:
    """Let a pipe hold more than usual, where the system allows it."""
    if sys.platform.startswith("linux"):
        with suppress(OSError):
            fcntl.fcntl(descriptor, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)


def pack(message: object) -> bytes:
    """A message as bytes; what it holds may change afterwards."""
    return pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)


class Outbox:
    """Messages on their way into a pipe that is never waited for."""

    def __init__(self, descriptor: int) -> None:
        os.set_blocking(descriptor, False)
        self._descriptor = descriptor
        self._parts: deque[memoryview] = deque()
        self._messages: deque[int] = deque()  # parts that each message still has here

    def __len__(self) -> int:
        """Messages that have not left completely."""
        return len(self._messages)

    def put(self, data: bytes) -> None:
        """Add a message that `pack` has made."""
        self._parts += [memoryview(_LENGTH.pack(len(data))), memoryview(data)]
        self._messages.append(2)

    def pump(self) -> None:
        """Move what the pipe has room for.

        Raises:
            BrokenPipeError: nobody reads any more.
        """
        with suppress(BlockingIOError):
            while self._parts:
                some = [self._parts[i] for i in range(min(len(self._parts), _MOST_PARTS))]
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
    """Messages out of a pipe."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._buffer = bytearray()

    def ready(self) -> Iterator[Any]:
        """What has arrived; ends where the pipe, which must not block, is empty.

        Raises:
            EOFError: nobody writes any more, and everything has been handed out.
        """
        yield from self._complete()
        with suppress(BlockingIOError):
            while True:
                self._fill()
                yield from self._complete()

    def _fill(self) -> None:
        data = os.read(self._descriptor, _READ_BYTES)
        if not data:
            raise EOFError
        self._buffer += data

    def _complete(self) -> Iterator[Any]:
        while len(self._buffer) >= _LENGTH.size:
            end = _LENGTH.size + _LENGTH.unpack_from(self._buffer)[0]
            if len(self._buffer) < end:
                return
            message = bytes(self._buffer[_LENGTH.size : end])
            del self._buffer[:end]
            yield _load(message)


def receive(descriptor: int) -> Iterator[Any]:
    """Messages out of a pipe, until nobody writes any more.

    It looks every few milliseconds instead of waiting in the pipe: whoever waits there is woken
    by the write, and takes the writer's core where there is no other.
    """
    os.set_blocking(descriptor, False)
    inbox = Inbox(descriptor)
    with suppress(EOFError):
        while True:
            yield from inbox.ready()
            time.sleep(_LOOK_EVERY_S)


def _load(data: bytes) -> Any:
    return pickle.loads(data)  # noqa: S301 - from the other end of our own pipe, never a file
