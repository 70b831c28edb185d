"""Time limits and retries for the requests of `huggingface_hub`.

The library repeats some requests and not others, waits as long as a server tells it to, and sets no
time limit on most. Within `retrying`, every request has a time limit, what may be repeated is
repeated after growing pauses, and then one clear error is raised.

Both majors of the library are supported: version 1 sends with `httpx`, version 2 with `httpx2`.
Only public names are used: the client of `huggingface_hub.get_session` gets another ``send`` within
the block. So a client that a user made with `set_client_factory`, with a proxy or certificates,
stays in use, and its connections stay open between blocks.
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
_OPTIONAL_S: Final = 5.0  # the library does without the answer to a request with a shorter limit
_PROGRESS_BYTES: Final = 1 << 20  # a download that breaks after this much is no failure


class HubUnreachable(EnvironmentFailure):
    """All attempts of a request to the Hub failed."""


@dataclass(frozen=True)
class RetryPolicy:
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


@cache
def http_library() -> Any:
    """The HTTP library of the installed `huggingface_hub`: the module `httpx` or `httpx2`."""
    from huggingface_hub.errors import HfHubHTTPError

    bases = (base.__module__.partition(".")[0] for base in HfHubHTTPError.__mro__)
    return importlib.import_module(next(name for name in bases if name.startswith("httpx")))


def uses_default_client() -> bool:
    """Whether requests are sent by the library's own client, not by one of the user's factory.

    The public attributes are compared; a user's client that differs in nothing but a proxy, and has
    the library's private hooks, is not recognised.
    """
    from huggingface_hub import get_session

    client = get_session()
    hooks = [hook for each in client.event_hooks.values() for hook in each]
    return (
        type(client) is http_library().Client
        and bool(hooks)
        and all(hook.__module__.startswith("huggingface_hub.") for hook in hooks)
    )


@contextlib.contextmanager
def retrying(policy: RetryPolicy) -> Iterator[None]:
    """Apply ``policy`` to every request of `huggingface_hub` in this process.

    Another thread that enters waits until this one has left; blocks must not be nested.

    Raises from those requests:
        HubUnreachable: names the request and its last failure, once the attempts are used up.
    """
    with RetryingClient(policy).open():
        yield


class RetryingClient:
    """`retrying` for blocks that several threads are in at the same time."""

    def __init__(self, policy: RetryPolicy) -> None:
        """Nothing is sent or replaced before a block is entered."""
        self._policy = policy

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        """A block as that of `retrying`, which other threads with this object may be in, too."""
        state, process = _state, os.getpid()
        state.enter(self, self._policy)
        try:
            yield
        finally:
            if os.getpid() == process:  # a forked child has a client and a state of its own
                state.leave()


class _State:
    """Which `RetryingClient` applies now: there is one client of the library per process."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._owner: RetryingClient | None = None
        self._users = 0
        self._restore: Callable[[], None] = lambda: None

    def enter(self, owner: RetryingClient, policy: RetryPolicy) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._owner in (None, owner))
            if self._owner is None:
                self._restore = _replace_send(policy)
                self._owner = owner
            self._users += 1

    def leave(self) -> None:
        with self._changed:
            self._users -= 1
            if self._users == 0:
                self._restore()
                self._owner = None
                self._changed.notify_all()


_state = _State()


def _reset_after_fork() -> None:
    """The library's client is a new one, and other threads, which may be in blocks, are gone."""
    global _state
    _state = _State()


os.register_at_fork(after_in_child=_reset_after_fork)


def _replace_send(policy: RetryPolicy) -> Callable[[], None]:
    """Let the library's client send through `_RetryingSend`; return what undoes that."""
    from huggingface_hub import get_session

    client: Any = get_session()
    send = client.send
    client.send = _RetryingSend(send, policy)

    def restore() -> None:
        client.send = send

    return restore


class _RetryingSend:
    """Replaces ``httpx.Client.send``: limits times, repeats, gives up."""

    def __init__(self, send: Callable[..., httpx.Response], policy: RetryPolicy) -> None:
        self._send, self._policy, self._http = send, policy, http_library()
        self._failures: Counter[str] = Counter()
        self._lock = threading.Lock()

    def __call__(self, request: httpx.Request, **options: Any) -> httpx.Response:
        limit = self._policy.timeout_s
        asked = request.extensions.get("timeout", {})
        kinds = ("connect", "read", "write", "pool")
        limits = {kind: min(asked.get(kind) or limit, limit) for kind in kinds}
        request.extensions["timeout"] = limits
        if limits["read"] < _OPTIONAL_S and limits["read"] < limit:
            return self._send(request, **options)
        if _is_commit(request):
            return self._send_once(request, options)
        if not isinstance(request.stream, self._http.ByteStream):
            return self._send_counted(request, options)
        return self._send_repeatedly(request, options)

    def _send_once(self, request: httpx.Request, options: dict[str, Any]) -> httpx.Response:
        """For a commit, which may have been made although no answer came; the caller looks."""
        try:
            response = self._send(request, **options)
        except self._http.TransportError as error:
            raise _given_up(request, _describe(error), 1) from error
        if response.status_code in _TRANSIENT:
            raise _given_up(request, _status(response), 1)
        return response

    def _send_counted(self, request: httpx.Request, options: dict[str, Any]) -> httpx.Response:
        """For a body that is a file, which only the library can rewind and repeat."""
        try:
            response = self._send(request, **options)
        except self._http.TransportError as error:
            self._count(request, _describe(error), error)
            # The library repeats after this error, too; after a ConnectError it would first drop
            # its client, and with it this object.
            raise self._http.RemoteProtocolError(_describe(error)) from error
        if response.status_code in _TRANSIENT:
            self._requested_pause(request, response)
            self._count(request, _status(response))
        return response

    def _send_repeatedly(self, request: httpx.Request, options: dict[str, Any]) -> httpx.Response:
        attempt = 1
        while True:
            asked = 0.0
            cause: Exception | None = None
            try:
                response = self._send(request, **options)
            except self._http.TransportError as error:
                found, cause = _describe(error), error
            else:
                if response.status_code not in _TRANSIENT:
                    return self._watched(request, response)
                found, asked = _status(response), self._requested_pause(request, response)
                response.close()
            if attempt >= self._policy.attempts:
                raise _given_up(request, found, attempt) from cause
            pause = max(self._policy.pause(attempt), asked)
            _LOG.warning("%s: %s; trying again in %.0f s", _name(request), found, pause)
            time.sleep(pause)
            attempt += 1

    def _watched(self, request: httpx.Request, response: httpx.Response) -> httpx.Response:
        """The response, with failures while its body is read counted."""
        if not response.is_closed and isinstance(response.stream, self._http.SyncByteStream):
            body = _body_class()
            response.stream = body(response.stream, lambda e: self._count(request, _describe(e), e))
        return response

    def _requested_pause(self, request: httpx.Request, response: httpx.Response) -> float:
        """Seconds that the Hub asks to wait, unless that is too long."""
        asked = _asked_pause(response.headers)
        if asked > self._policy.longest_wait_s:
            raise HubUnreachable(
                f"the Hub asks to wait {asked:.0f} s ({_status(response)} to {_name(request)}), "
                f"longer than {self._policy.longest_wait_s:.0f} s; try again later"
            )
        return asked

    def _count(self, request: httpx.Request, found: str, cause: Exception | None = None) -> None:
        name = _name(request)
        with self._lock:
            self._failures[name] += 1
            failures = self._failures[name]
            if failures >= self._policy.attempts:
                del self._failures[name]  # the next request starts with all attempts
        if failures >= self._policy.attempts:
            raise _given_up(request, found, failures) from cause


@cache
def _body_class() -> Any:
    """The class of a response's body that reports when it breaks off."""
    http = http_library()

    class Body(http.SyncByteStream):  # type: ignore[misc, name-defined]
        def __init__(self, stream: Any, broken: Callable[[Exception], None]) -> None:
            self._stream, self._broken = stream, broken

        def __iter__(self) -> Iterator[bytes]:
            arrived = 0
            try:
                for chunk in self._stream:
                    arrived += len(chunk)
                    yield chunk
            except http.TransportError as error:
                if arrived < _PROGRESS_BYTES:
                    self._broken(error)
                # The library resumes after this error, but not after all of its relatives.
                raise http.RemoteProtocolError(_describe(error)) from error

        def close(self) -> None:
            self._stream.close()

    return Body


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
