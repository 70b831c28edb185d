"""How long to try before the Hub is given up.

`huggingface_hub` repeats some requests and not others, waits as long as a server tells it
to, and sets no time limit on most. Within `patient`, every request has a time limit, what
may be repeated is repeated after growing pauses, and then one clear error is raised.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import httpx

from egovcp.bounds import bounded
from egovcp.errors import EnvironmentFailure

_LOG = logging.getLogger(__name__)
_TRANSIENT = {408, 429, 500, 502, 503, 504}
_OPTIONAL_S = 5.0  # what the library itself would wait less long for, it can do without
_PROGRESS_BYTES = 1 << 20  # a broken download that brought this much was worth its try
_ONE_AT_A_TIME = threading.Lock()  # the library has one client, whose factory is exchanged


class HubUnreachable(EnvironmentFailure):
    """The Hub did not answer, or not usefully, as often as it was asked."""


@dataclass(frozen=True)
class Patience:
    """How often and how long the Hub is asked."""

    attempts: int = bounded(5, least=1)
    """Tries per request, the first included."""
    wait_s: float = bounded(1.0, least=0)
    """Pause before the second try, s; doubles with each."""
    longest_wait_s: float = bounded(300.0, least=0)
    """Longest pause, s; if the Hub asks for a longer one it is given up."""
    timeout_s: float = bounded(60.0, above=0)
    """Longest silence within a request, s."""

    def pause(self, attempt: int) -> float:
        """Seconds to wait after the try with this number, counted from 1."""
        return min(self.wait_s * 2.0 ** (attempt - 1), self.longest_wait_s)


@contextlib.contextmanager
def patient(patience: Patience) -> Iterator[None]:
    """Hold every request of `huggingface_hub` in this process to ``patience``.

    Another thread that enters waits until this one has left; blocks are not to be nested.

    Raises from those requests, once the tries are used up:
        HubUnreachable: names the request and what came of it.
    """
    line = Line(patience)
    try:
        with line.open():
            yield
    finally:
        line.close()


def is_plain() -> bool:
    """Whether requests go out as the library sends them by itself, and not by a client with a
    proxy, certificates or the like that this process has set."""
    from huggingface_hub.utils import _http

    factory = _http._GLOBAL_CLIENT_FACTORY
    line = getattr(factory, "__self__", None)
    if isinstance(line, Line):  # another thread is in its block
        factory = line._before
    return factory is _http.default_client_factory


class Line:
    """`patient` for many blocks: connections stay open in between, threads share them.

    A client costs as much to make as many megabytes to download.
    """

    def __init__(self, patience: Patience) -> None:
        """Nothing is connected before the first request."""
        self._patience = patience
        self._lock = threading.Lock()
        self._users = 0
        self._client: httpx.Client | None = None
        self._made: tuple[Callable[[], httpx.Client], int] | None = None

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """A block as that of `patient`, which other threads with this line may be in, too."""
        with self._lock:
            if self._users == 0:
                self._enter()
            self._users += 1
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                if self._users == 0:
                    self._leave()

    def close(self) -> None:
        """Close the connections; the next block makes new ones."""
        client, self._client = self._client, None
        if client is not None:
            httpx.Client.close(client)

    def _enter(self) -> None:
        import huggingface_hub
        from huggingface_hub.utils import _http

        _ONE_AT_A_TIME.acquire()
        # The library lets one set the factory of its client, but not ask for the present one,
        # which may carry a user's proxy or certificates.
        self._before = _http._GLOBAL_CLIENT_FACTORY
        huggingface_hub.set_client_factory(self._kept)

    def _leave(self) -> None:
        import huggingface_hub

        huggingface_hub.set_client_factory(self._before)
        _ONE_AT_A_TIME.release()

    def _kept(self) -> httpx.Client:
        """The client, unless it is another factory's, or another process's: sockets survive a
        fork."""
        made = (self._before, os.getpid())
        if self._client is None or self._made != made:
            self._client, self._made = self._before(), made
            sender = _Sender(self._client.send, self._patience)
            self._client.send = sender  # type: ignore[method-assign]
            self._client.close = _stay_open  # type: ignore[method-assign]
        return self._client


def _stay_open() -> None:
    """In place of a client's `close`, which the library calls when its factory changes."""


class _Sender:
    """Stands before `httpx.Client.send`: limits, repeats, gives up."""

    def __init__(self, send: Callable[..., httpx.Response], patience: Patience) -> None:
        self._send, self._patience = send, patience
        self._failures: Counter[str] = Counter()
        self._lock = threading.Lock()

    def __call__(self, request: httpx.Request, **options: Any) -> httpx.Response:
        limit = self._patience.timeout_s
        asked = request.extensions.get("timeout", {})
        kinds = ("connect", "read", "write", "pool")
        limits = {kind: min(asked.get(kind) or limit, limit) for kind in kinds}
        request.extensions["timeout"] = limits
        if limits["read"] < _OPTIONAL_S and limits["read"] < limit:
            return self._send(request, **options)
        if _is_commit(request):
            return self._once(request, options)
        if not isinstance(request.stream, httpx.ByteStream):
            return self._counted(request, options)
        return self._repeated(request, options)

    def _once(self, request: httpx.Request, options: dict[str, Any]) -> httpx.Response:
        """A commit may have happened although no answer came: whoever asked must look."""
        try:
            response = self._send(request, **options)
        except httpx.TransportError as error:
            raise _given_up(request, _describe(error), 1) from error
        if response.status_code in _TRANSIENT:
            raise _given_up(request, _status(response), 1)
        return response

    def _counted(self, request: httpx.Request, options: dict[str, Any]) -> httpx.Response:
        """The body is a file that only the caller can rewind; the library repeats it."""
        try:
            response = self._send(request, **options)
        except httpx.TransportError as error:
            self._count(request, _describe(error), error)
            raise
        if response.status_code in _TRANSIENT:
            self._patience_for(request, response)
            self._count(request, _status(response))
        return response

    def _repeated(self, request: httpx.Request, options: dict[str, Any]) -> httpx.Response:
        attempt = 1
        while True:
            asked = 0.0
            cause: Exception | None = None
            try:
                response = self._send(request, **options)
            except httpx.TransportError as error:
                found, cause = _describe(error), error
            else:
                if response.status_code not in _TRANSIENT:
                    return self._watched(request, response)
                found, asked = _status(response), self._patience_for(request, response)
                response.close()
            if attempt >= self._patience.attempts:
                raise _given_up(request, found, attempt) from cause
            pause = max(self._patience.pause(attempt), asked)
            _LOG.warning("%s: %s; trying again in %.0f s", _name(request), found, pause)
            time.sleep(pause)
            attempt += 1

    def _watched(self, request: httpx.Request, response: httpx.Response) -> httpx.Response:
        if not response.is_closed and isinstance(response.stream, httpx.SyncByteStream):
            response.stream = _Body(
                response.stream, lambda e: self._count(request, _describe(e), e)
            )
        return response

    def _patience_for(self, request: httpx.Request, response: httpx.Response) -> float:
        """Seconds that the Hub asks to wait, unless that is too long."""
        asked = _asked_pause(response.headers)
        if asked > self._patience.longest_wait_s:
            raise HubUnreachable(
                f"the Hub asks to wait {asked:.0f} s ({_status(response)} to {_name(request)}), "
                f"longer than {self._patience.longest_wait_s:.0f} s; try again later"
            )
        return asked

    def _count(self, request: httpx.Request, found: str, cause: Exception | None = None) -> None:
        name = _name(request)
        with self._lock:
            self._failures[name] += 1
            failures = self._failures[name]
            if failures >= self._patience.attempts:
                del self._failures[name]  # whoever asks anew has all tries again
        if failures >= self._patience.attempts:
            raise _given_up(request, found, failures) from cause


class _Body(httpx.SyncByteStream):
    """A response's body; when it breaks off, the library may ask for the rest."""

    def __init__(self, stream: httpx.SyncByteStream, broken: Callable[[Exception], None]) -> None:
        self._stream, self._broken = stream, broken

    def __iter__(self) -> Iterator[bytes]:
        arrived = 0
        try:
            for chunk in self._stream:
                arrived += len(chunk)
                yield chunk
        except httpx.TransportError as error:
            if arrived < _PROGRESS_BYTES:
                self._broken(error)
            # The library resumes after this error, but not after every one of its relatives.
            raise httpx.RemoteProtocolError(_describe(error)) from error

    def close(self) -> None:
        self._stream.close()


def _is_commit(request: httpx.Request) -> bool:
    return request.method == "POST" and "/commit/" in request.url.path


def _asked_pause(headers: httpx.Headers) -> float:
    """Seconds from ``Retry-After``, or until the Hub's rate limit starts afresh."""
    if (wait := headers.get("Retry-After", "").strip()).isdigit():
        return float(wait)
    limit = re.search(r"r\s*=\s*0\s*;\s*t\s*=\s*(\d+)", headers.get("ratelimit", ""))
    return float(limit[1]) if limit else 0.0


def _given_up(request: httpx.Request, found: str, attempts: int) -> HubUnreachable:
    tries = f", {attempts} times" if attempts > 1 else ""
    return HubUnreachable(
        f"the Hub cannot be used: {found} to {_name(request)}{tries}; check the network and "
        "HF_ENDPOINT, or try again later"
    )


def _name(request: httpx.Request) -> str:
    """The request without its query, which may hold a signature."""
    return f"{request.method} {request.url.copy_with(query=None, userinfo=b'')}"


def _status(response: httpx.Response) -> str:
    return f"{response.status_code} {response.reason_phrase}"


def _describe(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__} ({lines[0]})" if lines else type(error).__name__
