"""A TCP proxy between a publisher and its subscriber that damages the byte stream."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import threading
import time
from enum import StrEnum
from typing import Final

_CHUNK: Final = 65536
_SPLIT_BYTES: Final = 64
_SLOW_BYTES: Final = 40  # per 2 ms: 20 kB/s, three states a second
_POLL_S: Final = 0.02


class StreamFault(StrEnum):
    """What the proxy does to the bytes sent to the subscriber."""

    PASS = "pass"
    """Forwarded unchanged."""
    SPLIT = "split"
    """Sent in pieces of 64 bytes."""
    SLOW = "slow"
    """20 kB/s."""
    STALL = "stall"
    """Nothing is forwarded; the connection stays open."""
    CUT = "cut"
    """The connection is reset, and new ones are refused."""


class StreamProxy:
    """Listens on a free loopback port and connects each client to ``upstream``.

    Args:
        upstream: port of the publisher on the loopback.
    """

    def __init__(self, upstream: int) -> None:
        self._upstream = upstream
        self.fault = StreamFault.PASS
        """May be set at any time."""
        self._server: socket.socket | None = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread and close all connections."""
        self._stop.set()
        self._thread.join()
        self._reset()
        if self._server is not None:
            self._server.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            if self.fault is StreamFault.CUT:
                self._reset()
                self._refuse()
                time.sleep(0.002)
                continue
            server = self._accepting()
            to_client = [] if self.fault is StreamFault.STALL else [up for _, up in self._pairs]
            readable = [server, *to_client, *(down for down, _ in self._pairs)]
            ready, _, _ = select.select(readable, [], [], _POLL_S)
            for end in ready:
                if end is server:
                    self._accept(server)
                else:
                    self._forward(end)

    def _accepting(self) -> socket.socket:
        if self._server is None:
            self._server = socket.create_server(("127.0.0.1", self.port))
        return self._server

    def _refuse(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None

    def _accept(self, server: socket.socket) -> None:
        down, _ = server.accept()
        up = socket.create_connection(("127.0.0.1", self._upstream))
        for end in (down, up):
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._pairs.append((down, up))

    def _forward(self, end: socket.socket) -> None:
        pair = next((pair for pair in self._pairs if end in pair), None)
        if pair is None:
            return
        down, up = pair
        try:
            data = end.recv(_CHUNK)
            if not data:
                raise ConnectionError
            if end is down:
                up.sendall(data)
            else:
                self._send(down, data)
        except OSError:
            self._pairs.remove(pair)
            _close(pair)

    def _send(self, down: socket.socket, data: bytes) -> None:
        size = {StreamFault.SPLIT: _SPLIT_BYTES, StreamFault.SLOW: _SLOW_BYTES}.get(
            self.fault, len(data)
        )
        for begin in range(0, len(data), size):
            down.sendall(data[begin : begin + size])
            if self.fault is StreamFault.SLOW:
                time.sleep(0.002)
            elif self.fault in (StreamFault.STALL, StreamFault.CUT) or self._stop.is_set():
                return  # the rest is lost, as in a real cut

    def _reset(self) -> None:
        for pair in self._pairs:
            for end in pair:  # RST instead of FIN
                with contextlib.suppress(OSError):
                    end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            _close(pair)
        self._pairs.clear()


def _close(pair: tuple[socket.socket, socket.socket]) -> None:
    for end in pair:
        end.close()
