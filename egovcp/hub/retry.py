"""Time limits and retries for the requests of `huggingface_hub`.

The library repeats some requests and not others, waits as long as a server demands, and sets no
time limit on most of them. Within `retrying`, every request has a time limit, is repeated after
growing pauses where that is safe, and ends with one clear error.

Versions 1 (which sends with `httpx`) and 2 (`httpx2`) of the library are supported through public
names: the client of `huggingface_hub.get_session` gets another ``send``, which does nothing
special outside of the blocks. A client that the user set with `set_client_factory`, with a proxy or
certificates, therefore stays in use.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from egovcp.bounds import bounded
from egovcp.errors import EnvironmentFailure

if TYPE_CHECKING:
    import httpx

_LOG = logging.getLogger(__name__)
_TRANSIENT: Final = {408, 429, 500, 502, 503, 504}
_OPTIONAL_S: Final = 5.0  # the library ignores failures of requests with a shorter limit
_PROGRESS_BYTES: Final = 1 << 20  # a download that breaks off after this much is not counted


class HubUnreachable(EnvironmentFailure):
    """All attempts of a request to the Hub failed."""


@dataclass(frozen=True)
class RetryPolicy:
    """Attempts, pauses and time limits of requests to the Hub."""

    attempts: int = bounded(5, least=1)
    """Attempts per request, the first included."""
    wait_s: float = bounded(1.0, least=0)
    """Pause before the second attempt, s; doubles with each."""
    longest_wait_s: float = bounded(300.0, least=0)
    """Longest pause, s; if the Hub demands a longer one, the request fails."""
    timeout_s: float = bounded(60.0, above=0)
    """Longest time without data within a request, s."""

    def pause(self, attempt: int) -> float:
        """Pause after attempt number ``attempt`` (from 1), s."""
        return min(self.wait_s * 2.0 ** (attempt - 1), self.longest_wait_s)


@cache
def http_library() -> Any:
    """The HTTP library of the installed `huggingface_hub`: the module `httpx` or `httpx2`."""
    from huggingface_hub.errors import HfHubHTTPError

    bases = (base.__module__.partition(".")[0] for base in HfHubHTTPError.__mro__)
    return importlib.import_module(next(name for name in bases if name.startswith("httpx")))


#: Policies of the open `retrying` blocks of this process; the first one applies.
_active: Final[list[RetryPolicy]] = []
_install_lock = threading.RLock()


@contextlib.contextmanager
def retrying(policy: RetryPolicy) -> Iterator[None]:
    """Apply ``policy`` to every request of `huggingface_hub` in this process.

    Blocks may be nested and may overlap in several threads; the policy of the oldest open block
    then applies to all, because the library has one client per process.

    Raises from those requests:
        HubUnreachable: names the request and its last failure after the last attempt.
    """
    from huggingface_hub import get_session

    with _install_lock:
        client: Any = get_session()
        if not isinstance(client.send, _RetryingSend):
            client.send = _RetryingSend(client.send)
    _active.append(policy)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):  # in a forked child
            _active.remove(policy)


def _reset_after_fork() -> None:
    """The library has a new client, and no block is open."""
    global _install_lock
    _install_lock = threading.RLock()
    _active.clear()


os.register_at_fork(after_in_child=_reset_after_fork)


class _RetryingSend:
    """Replacement of ``httpx.Client.send`` with time limits and retries in `retrying` blocks."""

    def __init__(self, send: Callable[..., httpx.Response]) -> None:
        self._send, self._http = send, http_library()
        self._failures: Counter[str] = Counter()
        self._lock = threading.Lock()

    @property
    def _policy(self) -> RetryPolicy:
        return _active[0] if _active else RetryPolicy()

    def __call__(self, request: httpx.Request, **options: Any) -> httpx.Response:
        if not _active:
            self._failures.clear()
            return self._send(request, **options)
        limit = self._policy.timeout_s
        given = request.extensions.get("timeout", {})
        kinds = ("connect", "read", "write", "pool")
        limits = {kind: min(given.get(kind) or limit, limit) for kind in kinds}
        request.extensions["timeout"] = limits
        if limits["read"] < _OPTIONAL_S and limits["read"] < limit:
            return self._send(request, **options)
        if request.method == "POST" and "/commit/" in request.url.path:
            return self._send_once(request, options)
        if not isinstance(request.stream, self._http.ByteStream):
            return self._send_file(request, options)
        return self._send_repeatedly(request, options)

    def _send_once(self, request: httpx.Request, options: dict[str, Any]) -> httpx.Response:
        """Send a commit. It may succeed although the answer is lost, so the caller must look."""
        try:
            response = self._send(request, **options)
        except self._http.TransportError as error:
            raise _unreachable(request, _describe(error), 1) from error
        if response.status_code in _TRANSIENT:
            raise _unreachable(request, _status(response), 1)
        return response

    def _send_file(self, request: httpx.Request, options: dict[str, Any]) -> httpx.Response:
        """Send a body that is a file. Only the library can rewind it, so it repeats the request."""
        try:
            response = self._send(request, **options)
        except self._http.TransportError as error:
            self._count_failure(request, _describe(error), error)
            # After a ConnectError the library would drop its client, and this object with it.
            raise self._http.RemoteProtocolError(_describe(error)) from error
        if response.status_code in _TRANSIENT:
            self._demanded_pause(request, response)
            self._count_failure(request, _status(response))
        return response

    def _send_repeatedly(self, request: httpx.Request, options: dict[str, Any]) -> httpx.Response:
        attempt = 1
        while True:
            demanded = 0.0
            cause: Exception | None = None
            try:
                response = self._send(request, **options)
            except self._http.TransportError as error:
                failure, cause = _describe(error), error
            else:
                if response.status_code not in _TRANSIENT:
                    return self._watch_body(request, response)
                failure, demanded = _status(response), self._demanded_pause(request, response)
                response.close()
            if attempt >= self._policy.attempts:
                raise _unreachable(request, failure, attempt) from cause
            pause = max(self._policy.pause(attempt), demanded)
            _LOG.warning("%s: %s; trying again in %.0f s", _name(request), failure, pause)
            time.sleep(pause)
            attempt += 1

    def _watch_body(self, request: httpx.Request, response: httpx.Response) -> httpx.Response:
        """The response; failures while its body is read are counted."""
        if not response.is_closed and isinstance(response.stream, self._http.SyncByteStream):
            body = _body_class()
            response.stream = body(
                response.stream, lambda e: self._count_failure(request, _describe(e), e)
            )
        return response

    def _demanded_pause(self, request: httpx.Request, response: httpx.Response) -> float:
        """Seconds from ``Retry-After``, or until the Hub's rate limit is reset.

        Raises:
            HubUnreachable: they are more than the policy allows.
        """
        headers, demanded = response.headers, 0.0
        if (wait := headers.get("Retry-After", "").strip()).isdigit():
            demanded = float(wait)
        elif limit := re.search(r"r\s*=\s*0\s*;\s*t\s*=\s*(\d+)", headers.get("ratelimit", "")):
            demanded = float(limit[1])
        if demanded > self._policy.longest_wait_s:
            raise HubUnreachable(
                f"the Hub demands a pause of {demanded:.0f} s ({_status(response)} to "
                f"{_name(request)}), longer than {self._policy.longest_wait_s:.0f} s; try again "
                "later"
            )
        return demanded

    def _count_failure(
        self, request: httpx.Request, failure: str, cause: Exception | None = None
    ) -> None:
        """Count a failure that the library repeats; raise `HubUnreachable` at the last attempt."""
        name = _name(request)
        with self._lock:
            self._failures[name] += 1
            failures = self._failures[name]
            if failures >= self._policy.attempts:
                del self._failures[name]  # the next request starts with all attempts
        if failures >= self._policy.attempts:
            raise _unreachable(request, failure, failures) from cause


@cache
def _body_class() -> Any:
    """The class of a response's body that reports when it breaks off."""
    http = http_library()

    class Body(http.SyncByteStream):  # type: ignore[misc, name-defined]
        def __init__(self, stream: Any, on_break: Callable[[Exception], None]) -> None:
            self._stream, self._on_break = stream, on_break

        def __iter__(self) -> Iterator[bytes]:
            received = 0
            try:
                for chunk in self._stream:
                    received += len(chunk)
                    yield chunk
            except http.TransportError as error:
                if received < _PROGRESS_BYTES:
                    self._on_break(error)
                # The library resumes after this error, but not after every TransportError.
                raise http.RemoteProtocolError(_describe(error)) from error

        def close(self) -> None:
            self._stream.close()

    return Body


def _unreachable(request: httpx.Request, failure: str, attempts: int) -> HubUnreachable:
    tries = f", {attempts} times" if attempts > 1 else ""
    return HubUnreachable(
        f"the Hub cannot be used: {failure} to {_name(request)}{tries}; check the network and "
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
