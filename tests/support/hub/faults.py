"""Fault injection for the fake Hub."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass
from typing import Literal

type HubFaultKind = int | Literal["reset", "stall", "truncate", "lose"]
"""What to do to a request: respond with that HTTP status, or

- ``reset``: break the connection instead of responding,
- ``stall``: send half of the response's body, then nothing; no response if it has no body,
- ``truncate``: send half of the response's body, then close the connection; break it if the body is
  empty, and respond to a HEAD request as usual,
- ``lose``: do what was asked, then break the connection.
"""

ALWAYS = 10**9


@dataclass
class Fault:
    """A fault of the next requests of a route."""

    route: str
    """Name of the route (see `tests.support.hub.routes.ROUTES`); ``*``: any."""
    kind: HubFaultKind
    times: int = ALWAYS
    """Number of requests that it applies to."""
    after: int = 0
    """Number of requests that it skips first."""
    retry_after: int | None = None
    """Seconds of the ``Retry-After`` header of a status; None: no such header."""
    message: str = ""
    """The error message of the response."""


class HubFaults:
    """The faults still to come, and the count of requests per route."""

    def __init__(self) -> None:
        self.requests: Counter[str] = Counter()
        self._pending: list[Fault] = []
        self._lock = threading.Lock()

    def add(self, fault: Fault) -> None:
        """Append a fault; the first one that fits a request applies to it."""
        with self._lock:
            self._pending.append(fault)

    def clear(self) -> None:
        """Forget all faults and counts."""
        with self._lock:
            self._pending.clear()
            self.requests.clear()

    def take(self, route: str) -> Fault | None:
        """Count a request; return the fault that applies to it."""
        with self._lock:
            self.requests[route] += 1
            for fault in self._pending:
                if fault.route not in (route, "*") or fault.times <= 0:
                    continue
                if fault.after > 0:
                    fault.after -= 1
                    continue
                fault.times -= 1
                return fault
            return None
