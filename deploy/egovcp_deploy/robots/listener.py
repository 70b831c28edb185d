"""Receives from a publisher in a thread that stamps messages when it takes them.

All messages that have arrived are taken at once, and the newest usable one counts. After that the
thread rests: for 3 ms or four times as long as its work took, whichever is longer; where nothing
was usable, or much had to be searched, for forty times as long, up to 15 ms. So a flood costs
messages, but the interpreter's lock, which the control loop needs as well, is held for little of
the time: on loaded cores a thread that holds it may be put aside for many milliseconds.

A message is taken up to 15 ms after its arrival. Where more messages wait than the queue holds,
older ones may wait in the network as well, and none of them is used.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from typing import Final

import zmq

from egovcp.errors import EnvironmentFailure

_POLL_MS: Final = 50
_QUEUE: Final = 512  # messages
_REST_S: Final = 0.003  # after a usable message: 50 Hz loops need no 500 Hz
_REST_SHARE: Final = 4.0  # of the time that handling the messages took
_FLOOD_SHARE: Final = 40.0  # likewise in a flood
_MOST_REST_S: Final = 0.015
_FLOOD: Final = 8  # more messages at once than this are one
_WORK_NS: Final = 2_000_000  # after which no older message is tried
_SILENCE_S: Final = 1.0  # after which the connection is made anew
_PROBE_S: Final = 1.0


def join(end: zmq.Socket[bytes], host: str, port: int) -> None:
    """Connect ``end``, without waiting for an answer; its heartbeat notices a pulled cable.

    Raises:
        EnvironmentFailure: that is no address.
    """
    address = f"tcp://{host}:{port}"
    end.setsockopt(zmq.LINGER, 0)
    end.setsockopt(zmq.RECONNECT_IVL, 20)  # ms
    end.setsockopt(zmq.HEARTBEAT_IVL, 200)  # ms
    end.setsockopt(zmq.HEARTBEAT_TIMEOUT, 1000)
    try:
        end.connect(address)
    except zmq.ZMQError as error:
        raise EnvironmentFailure(
            f"{address} is no address ({error.strerror}); expected the name or the address of a "
            "machine"
        ) from error


def probe(host: str, port: int) -> str:
    """Why nothing can be there, in words; empty: something listens."""
    try:
        socket.create_connection((host, port), _PROBE_S).close()
    except (socket.gaierror, UnicodeError):  # the latter: too long to be a name
        return "no machine has that name"
    except OSError as error:
        return error.strerror or "no answer"
    return ""


def _waiting(end: zmq.Socket[bytes]) -> list[bytes]:
    """What has arrived, oldest first; at most `_QUEUE`."""
    messages: list[bytes] = []
    while len(messages) < _QUEUE:
        try:
            messages.append(end.recv(zmq.NOBLOCK))
        except zmq.Again:
            break
    return messages


class Listener:
    """One subscription.

    Args:
        host: of the publisher.
        port: its port.
        most_bytes: longer messages end the connection, which is then made anew.
        take: handles a message, given with its time of arrival, monotonic ns; returns whether it
            was usable. Called in the thread, with the newest message first until one is.

    Raises:
        EnvironmentFailure: that is no address.
    """

    def __init__(
        self, host: str, port: int, most_bytes: int, take: Callable[[bytes, int], bool]
    ) -> None:
        self._address = f"tcp://{host}:{port}"
        self._take = take
        self._context = zmq.Context()
        end = self._context.socket(zmq.SUB)
        end.setsockopt(zmq.RCVHWM, _QUEUE)
        end.setsockopt(zmq.MAXMSGSIZE, most_bytes)
        end.setsockopt(zmq.SUBSCRIBE, b"")
        try:
            join(end, host, port)
        except EnvironmentFailure:
            self._context.destroy(linger=0)
            raise
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._listen, args=(end,), daemon=True)
        self._thread.start()

    def _listen(self, end: zmq.Socket[bytes]) -> None:
        heard = time.monotonic()
        with contextlib.closing(end):
            while not self._stop.is_set():
                if end.poll(_POLL_MS):
                    begin = time.monotonic()
                    messages = _waiting(end)
                    usable = self._take_newest(messages)
                    heard = time.monotonic()
                    calm = usable and len(messages) <= _FLOOD
                    share = _REST_SHARE if calm else _FLOOD_SHARE
                    rest = min(share * (heard - begin), _MOST_REST_S)
                    self._stop.wait(max(rest, _REST_S) if usable else rest)
                elif time.monotonic() - heard > _SILENCE_S:
                    # libzmq never comes back by itself from a message that was too long
                    end.disconnect(self._address)
                    end.connect(self._address)
                    heard = time.monotonic()

    def _take_newest(self, messages: list[bytes]) -> bool:
        """Whether one of ``messages``, oldest first, was usable."""
        now = time.monotonic_ns()
        deadline = now + _WORK_NS
        if len(messages) >= _QUEUE:
            return False
        for message in reversed(messages):
            if self._take(message, now):
                return True
            if time.monotonic_ns() > deadline:
                return False
        return False

    def close(self) -> None:
        """End the thread; further calls do nothing."""
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join()
            self._context.term()
