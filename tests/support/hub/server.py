"""The server: sockets, credentials and faults around the routes."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import parse_qsl, unquote, urlsplit

from tests.support.hub.faults import ALWAYS, Fault, HubFaultKind, HubFaults
from tests.support.hub.messages import Request, Response, arriving, json_response
from tests.support.hub.routes import ROUTES, Route
from tests.support.hub.store import HttpError, Store

_STALL_S = 3600.0
_READING = {"GET", "HEAD"}


class FakeHub:
    """A Hub on the loopback whose repositories lie in a folder.

    As a context manager it serves on a free port until the block ends::

        with FakeHub(tmp_path / "hub") as hub:
            hub.fail("commit", 503, times=2)
            ...
            assert hub.requests["commit"] == 3
    """

    def __init__(self, root: str | Path, port: int = 0, token: str = "") -> None:
        """Open the folder and the port; ``token``: needed to write and to read private data."""
        self.store = Store(Path(root))
        self.token = token
        self.faults = HubFaults()
        self.closing = threading.Event()
        self._server = _Server(("127.0.0.1", port), partial(_Handler, hub=self))

    @property
    def endpoint(self) -> str:
        """The address for ``HF_ENDPOINT``."""
        return f"http://127.0.0.1:{self._server.server_port}"

    @property
    def requests(self) -> dict[str, int]:
        """How many requests each route has had; 0 for one without."""
        return self.faults.requests

    def fail(
        self,
        route: str,
        kind: HubFaultKind,
        times: int = ALWAYS,
        after: int = 0,
        retry_after: int | None = None,
        message: str = "",
    ) -> None:
        """Order a fault; see `Fault`."""
        self.faults.add(Fault(route, kind, times, after, retry_after, message))

    def reset(self) -> None:
        """Forget all faults and counts."""
        self.faults.clear()

    def serve(self) -> None:
        """Respond to requests until `close`."""
        self._server.serve_forever(poll_interval=0.05)

    def close(self) -> None:
        """Stop answering; end what stalls."""
        self.closing.set()
        self._server.shutdown()
        self._server.server_close()

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self.serve, daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def handle_error(self, request: object, client_address: object) -> None:
        """A client that goes away is no event."""


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def __init__(self, *args: object, hub: FakeHub) -> None:
        self.hub = hub
        super().__init__(*args)  # type: ignore[arg-type]

    def log_message(self, *args: object) -> None:
        """Say nothing."""

    def _handle(self) -> None:
        url = urlsplit(self.path)
        route, parts = _find(self.command, url.path)
        headers = {name.lower(): value for name, value in self.headers.items()}
        request = Request(
            endpoint=self.hub.endpoint,
            parts=parts,
            query=dict(parse_qsl(url.query)),
            headers=headers,
            body=arriving(self.rfile, headers),  # type: ignore[arg-type]
        )
        fault = self.hub.faults.take(route.name if route else "unknown")
        kind = fault.kind if fault else None
        if kind == "reset":
            return self._break()
        if fault is not None and isinstance(kind, int):
            response = _error_response(
                HttpError(kind, fault.message or "as ordered"), fault.retry_after
            )
        else:
            response = self._respond(route, request)
        for _ in request.body:  # what no route has read: the connection is used again
            pass
        half = kind in ("stall", "truncate")
        if kind == "truncate" and self.command == "HEAD":
            half = False  # complete without a body: the client uses the connection again
        empty = response.size == 0 or self.command == "HEAD"
        if kind == "stall" and empty:
            self.hub.closing.wait(_STALL_S)
        if kind == "lose" or (half and empty):
            return self._break()
        return self._send(response, half, stall=kind == "stall")

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = _handle  # noqa: N815

    def _respond(self, route: Route | None, request: Request) -> Response:
        try:
            if route is None:
                raise HttpError(404, f"no route for {self.command} {self.path}")
            self._authorize(route, request)
            return route.handler(self.hub.store, request)
        except HttpError as error:
            return _error_response(error, None)

    def _authorize(self, route: Route, request: Request) -> None:
        token = request.headers.get("authorization", "").removeprefix("Bearer ")
        if not self.hub.token or token == self.hub.token or route.name.startswith("lfs_"):
            return
        public = route.method in _READING or route.name == "paths"
        if "repo" in request.parts and public and not self.hub.store.refs(request.repo).private:
            return
        if token or route.name != "create":
            raise HttpError(401, "Invalid username or password.")
        raise HttpError(401, "Unauthorized")

    def _send(self, response: Response, half: bool, stall: bool) -> None:
        self.send_response(response.status)
        for name, value in response.headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(response.size))
        self.end_headers()
        limit = response.size // 2 if half else response.size
        if self.command != "HEAD":
            for chunk in response.chunks(limit):
                self.wfile.write(chunk)
        if stall:
            self.hub.closing.wait(_STALL_S)
        self.close_connection = self.close_connection or half

    def _break(self) -> None:
        """End the connection as a crash does: without a farewell."""
        self.close_connection = True
        with contextlib.suppress(OSError):
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self.connection.close()


def _find(method: str, path: str) -> tuple[Route | None, dict[str, str]]:
    """The route of a path, and the parts that its pattern names, unquoted."""
    for route in ROUTES:
        found = route.pattern.fullmatch(path) if route.method == method else None
        if found is not None:
            parts = {k: unquote(v) for k, v in found.groupdict().items() if v is not None}
            return route, parts
    return None, {}


def _error_response(error: HttpError, retry_after: int | None) -> Response:
    headers = {"Content-Type": "application/json", "X-Error-Message": error.message}
    if error.code:
        headers["X-Error-Code"] = error.code
    if retry_after is not None:
        headers["Retry-After"] = str(retry_after)
    return json_response({"error": error.message}, error.status, headers)
