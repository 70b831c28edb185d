"""A TCP proxy between a publisher and its subscriber that damages the stream of bytes."""

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


class Stream(StrEnum):
    """What happens to the bytes on their way to the subscriber."""

    PASS = "pass"
    SPLIT = "split"
    """Sent in pieces of 64 bytes."""
    SLOW = "slow"
    """20 kB/s."""
    STALL = "stall"
    """Nothing is passed on; the connection stays open."""
    CUT = "cut"
    """The connection is reset, and new ones are refused."""


class Proxy:
    """Listens on a free port of the loopback and connects each client to ``upstream``.

    Args:
        upstream: port of the publisher on the loopback.
    """

    def __init__(self, upstream: int) -> None:
        self._upstream = upstream
        self.stream = Stream.PASS
        """May be set at any time."""
        self._server: socket.socket | None = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and all connections."""
        self._stop.set()
        self._thread.join()
        self._reset()
        if self._server is not None:
            self._server.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            if self.stream is Stream.CUT:
                self._reset()
                self._refuse()
                time.sleep(0.002)
                continue
            server = self._accepting()
            to_client = [] if self.stream is Stream.STALL else [up for _, up in self._pairs]
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
                self._pass_on(down, data)
        except OSError:
            self._pairs.remove(pair)
            _close(pair)

    def _pass_on(self, down: socket.socket, data: bytes) -> None:
        size = {Stream.SPLIT: _SPLIT_BYTES, Stream.SLOW: _SLOW_BYTES}.get(self.stream, len(data))
        for begin in range(0, len(data), size):
            down.sendall(data[begin : begin + size])
            if self.stream is Stream.SLOW:
                time.sleep(0.002)
            elif self.stream in (Stream.STALL, Stream.CUT) or self._stop.is_set():
                return  # the rest of the piece is lost, as in a real cut

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
