"""Time limits and retries for calls of `huggingface_hub`.

The library repeats some requests and not others, waits as long as a server demands, and sets no
time limit on most of them. Within `call_hub`, every request of its HTTP client has a time limit and
fails at once. Files that are transferred by `hf_xet` keep its time limits and repetitions, which
may last some minutes. In both cases the whole call is repeated after growing pauses.

The client of `huggingface_hub.get_session` gets another ``send``, which does nothing special
outside of `call_hub`. A client that the user set with `set_client_factory`, with a proxy or
certificates, therefore stays in use.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING, Any, Final

from egovcp.bounds import bounded
from egovcp.hub.errors import (
    HubUnreachable,
    RepoType,
    describe,
    http_library,
    hub_errors,
    unreachable,
)

if TYPE_CHECKING:
    import httpx

_LOG = logging.getLogger(__name__)
_TRANSIENT: Final = {408, 429, 500, 502, 503, 504}
_OPTIONAL_S: Final = 5.0  # the library ignores failures of requests with a shorter limit


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
    """Longest time without data within a request, s; `hf_xet` has its own limits."""

    def pause(self, attempt: int) -> float:
        """Pause after attempt number ``attempt`` (from 1), s."""
        return min(self.wait_s * 2.0 ** (attempt - 1), self.longest_wait_s)


#: Policies of the running calls of `call_hub` in this process; the first one applies, also to the
#: threads of the library.
_active: Final[list[RetryPolicy]] = []


def call_hub[R](
    call: Callable[[], R],
    retry: RetryPolicy,
    repo_id: str,
    revision: str = "",
    writing: bool = False,
    repo_type: RepoType = "dataset",
) -> R:
    """Call a function that sends requests with `huggingface_hub`, again while it fails.

    The function may be called several times, so an interrupted call must be completed by the next.

    Raises:
        HubUnreachable: names the request and its last failure after the last attempt.
        EgovcpError: see `hub_errors`.
    """
    for attempt in count(1):
        try:
            with hub_errors(repo_id, revision, writing, repo_type), _limited(retry):
                return call()
        except HubUnreachable as error:
            if error.pause_s > retry.longest_wait_s:
                raise HubUnreachable(
                    f"{error}; it demands a pause of {error.pause_s:.0f} s, longer than "
                    f"{retry.longest_wait_s:.0f} s"
                ) from error
            if attempt >= retry.attempts:
                raise
            pause = max(retry.pause(attempt), error.pause_s)
            _LOG.warning("%s; trying again in %.0f s", error, pause)
            time.sleep(pause)
    raise AssertionError("unreachable")


@contextmanager
def _limited(policy: RetryPolicy) -> Iterator[None]:
    """Apply the time limit of ``policy``; failures of requests raise `HubUnreachable` at once."""
    from huggingface_hub import get_session

    client: Any = get_session()
    if not isinstance(client.send, _LimitedSend):
        client.send = _LimitedSend(client.send)
    _active.append(policy)
    try:
        yield
    finally:
        _active.remove(policy)


class _LimitedSend:
    """Replacement of ``httpx.Client.send``."""

    def __init__(self, send: Callable[..., httpx.Response]) -> None:
        self._send = send

    def __call__(self, request: httpx.Request, **options: Any) -> httpx.Response:
        if not _active:
            return self._send(request, **options)
        limit = _active[0].timeout_s
        given = request.extensions.get("timeout", {})
        kinds = ("connect", "read", "write", "pool")
        limits = {kind: min(given.get(kind) or limit, limit) for kind in kinds}
        request.extensions["timeout"] = limits
        if limits["read"] < _OPTIONAL_S and limits["read"] < limit:
            return self._send(request, **options)
        name = f"{request.method} {request.url.copy_with(query=None, userinfo=b'')}"
        try:
            response = self._send(request, **options)
        except http_library().TransportError as error:
            raise unreachable(f"{describe(error)} to {name}") from error
        if response.status_code in _TRANSIENT:
            response.close()
            status = f"{response.status_code} {response.reason_phrase}"
            raise unreachable(f"{status} to {name}", _demanded_pause(response))
        return response


def _demanded_pause(response: httpx.Response) -> float:
    """Seconds from ``Retry-After``, or until the Hub's rate limit is reset."""
    headers = response.headers
    if (wait := headers.get("Retry-After", "").strip()).isdigit():
        return float(wait)
    limit = re.search(r"r\s*=\s*0\s*;\s*t\s*=\s*(\d+)", headers.get("ratelimit", ""))
    return float(limit[1]) if limit else 0.0
