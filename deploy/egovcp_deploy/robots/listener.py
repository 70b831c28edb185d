"""Receives from a publisher, newest message only, in a thread that stamps each on arrival.

After a usable message the thread rests for 3 ms. After any message it rests for four times as long
as handling it took: a flood costs it messages, and this process at most a fifth of one core and of
the interpreter's lock, whatever the messages are. Nothing queues up: ZMQ keeps the newest message
and throws the older ones away in a thread of its own, so no reading is older than it seems.
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
_REST_S: Final = 0.003  # after a usable message: 50 Hz loops need no 500 Hz
_REST_SHARE: Final = 4.0  # of the time that handling a message took
_SILENCE_S: Final = 1.0  # after which the connection is made anew
_PROBE_S: Final = 1.0


def join(end: zmq.Socket[bytes], host: str, port: int) -> None:
    """Connect ``end``, without waiting for an answer; its heartbeat notices a pulled cable.

    Raises:
        EnvironmentFailure: that is no address.
    """
    address = f"tcp://{host}:{port}"
    end.setsockopt(zmq.LINGER, 0)
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


class Listener:
    """One subscription.

    Args:
        host: of the publisher.
        port: its port.
        most_bytes: longer messages end the connection, which is then made anew.
        take: handles a message, given with its time of arrival, monotonic ns; returns whether it
            was usable. Called in the thread.

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
        end.setsockopt(zmq.CONFLATE, 1)
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
                    usable = self._take(end.recv(), time.monotonic_ns())
                    heard = time.monotonic()
                    rest = _REST_SHARE * (heard - begin)
                    self._stop.wait(max(rest, _REST_S) if usable else rest)
                elif time.monotonic() - heard > _SILENCE_S:
                    # libzmq never comes back by itself from a message that was too long
                    end.disconnect(self._address)
                    end.connect(self._address)
                    heard = time.monotonic()

    def close(self) -> None:
        """End the thread; further calls do nothing."""
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join()
            self._context.term()
