"""ZMQ subscriptions that are received in a thread, and statistics of their arrivals.

The thread takes all waiting messages at once and keeps the newest usable one. Then it sleeps for
3 ms or four times its processing time, whichever is longer; after a flood, or if no message was
usable, for forty times its processing time, at most 15 ms. A flood therefore costs messages, but
the thread holds the interpreter's lock, which the control loop needs, for a small share of the
time. A message is taken at most 15 ms after its arrival. If the queue is full, older messages may
wait in the network as well, so none of them is used.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import takewhile
from typing import Final

import numpy as np
import zmq

from egovcp.errors import EnvironmentFailure
from egovcp.rate import NS_PER_S
from egovcp_deploy.robots.wire import MalformedMessage

WINDOW_S: Final = 1.0
_MAX_ARRIVALS: Final = 5000  # 10 s at 500 Hz
_POLL_MS: Final = 50
_QUEUE: Final = 512  # messages
_SLEEP_S: Final = 0.003  # after a usable message: 50 Hz loops need no 500 Hz
_SLEEP_RATIO: Final = 4.0  # of the processing time
_FLOOD_SLEEP_RATIO: Final = 40.0
_MAX_SLEEP_S: Final = 0.015
_FLOOD: Final = 8  # more waiting messages than this are a flood
_MAX_WORK_NS: Final = 2_000_000  # no older message is tried after this
_RECONNECT_S: Final = 1.0  # silence after which the connection is renewed
_PROBE_S: Final = 1.0


@dataclass(frozen=True)
class ArrivalStats:
    """Statistics of the messages that arrived within a window."""

    rate_hz: float = 0.0  # messages used per second: of those that wait together, the newest
    jitter_ms: float = 0.0  # 99th percentile of |interval - median interval|
    gap_ms: float = 0.0  # longest time without a usable message, also since the last one
    lost: float = 0.0  # share of the sent messages that did not arrive or were not usable


class ArrivalMonitor:
    """Records arrival times; thread-safe. With ``estimate_losses``, an interval of k median
    intervals counts as k - 1 losses, if `record_loss` has reported fewer."""

    def __init__(self, estimate_losses: bool = True) -> None:
        self._estimate_losses = estimate_losses
        self._lock = threading.Lock()
        self._times: deque[int] = deque(maxlen=_MAX_ARRIVALS)
        self._losses: deque[tuple[int, int]] = deque(maxlen=_MAX_ARRIVALS)

    def record_arrival(self, time_ns: int) -> None:
        """Record a usable message that arrived at ``time_ns``, monotonic."""
        with self._lock:
            self._times.append(time_ns)

    def record_loss(self, time_ns: int, count: int = 1) -> None:
        """Record ``count`` lost or unusable messages."""
        with self._lock:
            self._losses.append((time_ns, count))

    def stats(self, now_ns: int, window_s: float = WINDOW_S) -> ArrivalStats:
        """Compute the statistics of the last ``window_s`` seconds."""
        begin = now_ns - round(window_s * NS_PER_S)
        with self._lock:
            newest_first = takewhile(lambda t: t > begin, reversed(self._times))
            times = np.array(list(newest_first)[::-1], np.int64)
            recent = takewhile(lambda loss: loss[0] > begin, reversed(self._losses))
            lost = sum(count for _, count in recent)
        if not len(times):
            return ArrivalStats(gap_ms=window_s * 1e3, lost=1.0)
        gap = (now_ns - int(times[-1])) / 1e6
        if len(times) == 1:
            return ArrivalStats(1 / window_s, 0.0, gap, lost / (lost + 1))
        intervals = np.diff(times) / 1e6
        median = np.median(intervals)
        if self._estimate_losses:  # unusable messages also leave gaps
            lost = max(lost, int(np.rint(intervals / median - 1.0).clip(min=0.0).sum()))
        return ArrivalStats(
            rate_hz=len(times) / window_s,
            jitter_ms=float(np.percentile(np.abs(intervals - median), 99)),
            gap_ms=max(float(intervals.max()), gap),
            lost=lost / (lost + len(times)),
        )


def connect_socket(end: zmq.Socket[bytes], host: str, port: int) -> None:
    """Connect without waiting for an answer; a heartbeat detects a broken connection. Raises
    `EnvironmentFailure` if the address is invalid."""
    address = f"tcp://{host}:{port}"
    end.setsockopt(zmq.LINGER, 0)
    end.setsockopt(zmq.RECONNECT_IVL, 20)  # ms
    end.setsockopt(zmq.HEARTBEAT_IVL, 200)  # ms
    end.setsockopt(zmq.HEARTBEAT_TIMEOUT, 1000)
    try:
        end.connect(address)
    except zmq.ZMQError as error:
        raise EnvironmentFailure(
            f"{address} is not a valid address ({error.strerror}); expected a host name or an IP "
            "address"
        ) from error


def bind_socket(end: zmq.Socket[bytes], host: str, port: int) -> int:
    """Listen at ``host`` and return the port; 0 selects a free one. Raises `EnvironmentFailure` if
    it is in use, or the address is not of this machine."""
    end.setsockopt(zmq.LINGER, 0)
    try:
        end.bind(f"tcp://{host}:{port or '*'}")
    except zmq.ZMQError as error:
        raise EnvironmentFailure(
            f"cannot listen at {host}:{port}: {error.strerror}; stop the program that uses the "
            "port, perhaps another egovcp-fake-g1, or choose another port"
        ) from error
    return int(end.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])


def connection_error(host: str, port: int) -> str:
    """Try to connect; returns the reason of a failure, empty if something listens there."""
    try:
        socket.create_connection((host, port), _PROBE_S).close()
    except (socket.gaierror, UnicodeError):  # the latter: too long for a name
        return "unknown host name"
    except OSError as error:
        return error.strerror or "no answer"
    return ""


def _waiting(end: zmq.Socket[bytes]) -> list[bytes]:
    """Receive the waiting messages, oldest first, at most `_QUEUE`."""
    messages: list[bytes] = []
    with contextlib.suppress(zmq.Again):
        while len(messages) < _QUEUE:
            messages.append(end.recv(zmq.NOBLOCK))
    return messages


class Subscriber:
    """One subscription with its receiving thread; raises `EnvironmentFailure` if the address is
    invalid. A message beyond ``max_bytes`` ends the connection, which is then renewed.

    ``handle`` is called in the thread with a message, its arrival time (monotonic ns) and the
    number of older messages that arrived with it, newest message first, until it returns that one
    was usable. No message ends the thread: an exception goes to ``reject``, as text, with the time.
    """

    def __init__(
        self,
        host: str,
        port: int,
        max_bytes: int,
        handle: Callable[[bytes, int, int], bool],
        reject: Callable[[str, int], None],
    ) -> None:
        self._address = f"tcp://{host}:{port}"
        self._handle, self._reject = handle, reject
        self._context = zmq.Context()
        end = self._context.socket(zmq.SUB)
        end.setsockopt(zmq.RCVHWM, _QUEUE)
        end.setsockopt(zmq.MAXMSGSIZE, max_bytes)
        end.setsockopt(zmq.SUBSCRIBE, b"")
        try:
            connect_socket(end, host, port)
        except EnvironmentFailure:
            self._context.destroy(linger=0)
            raise
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._receive, args=(end,), daemon=True)
        self._thread.start()

    def _receive(self, end: zmq.Socket[bytes]) -> None:
        received = time.monotonic()
        with contextlib.closing(end):
            while not self._stop.is_set():
                if end.poll(_POLL_MS):
                    begin = time.monotonic()
                    messages = _waiting(end)
                    usable = self._handle_newest(messages)
                    received = time.monotonic()
                    calm = usable and len(messages) <= _FLOOD
                    ratio = _SLEEP_RATIO if calm else _FLOOD_SLEEP_RATIO
                    pause = min(ratio * (received - begin), _MAX_SLEEP_S)
                    self._stop.wait(max(pause, _SLEEP_S) if usable else pause)
                elif time.monotonic() - received > _RECONNECT_S:
                    # libzmq does not reconnect by itself after a message that was too long
                    end.disconnect(self._address)
                    end.connect(self._address)
                    received = time.monotonic()

    def _handle_newest(self, messages: list[bytes]) -> bool:
        """Whether one of ``messages``, oldest first, was usable."""
        now = time.monotonic_ns()
        if len(messages) >= _QUEUE:
            return False
        for older, message in reversed(list(enumerate(messages))):
            try:
                if self._handle(message, now, older):
                    return True
            except MalformedMessage as error:
                self._reject(str(error), now)
            except Exception as error:  # noqa: BLE001 - else no later message would be received
                place = traceback.extract_tb(error.__traceback__)[-1]
                self._reject(f"{error!r} in {place.filename}:{place.lineno}", now)
            if time.monotonic_ns() > now + _MAX_WORK_NS:
                return False
        return False

    def close(self) -> None:
        """Stop the thread; may be called more than once."""
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join()
            self._context.term()
