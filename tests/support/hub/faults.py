"""What goes wrong on the way to the Hub, on demand."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass
from typing import Literal

type Trouble = int | Literal["reset", "stall", "truncate", "lose"]
"""What to do to a request: respond with that HTTP status, or

- ``reset``: break the connection instead of responding,
- ``stall``: send half of the response's body, then nothing; no response if it has no body,
- ``truncate``: send half of the response's body, then close the connection; break it if the body is
  empty, and respond to a HEAD request as usual,
- ``lose``: do what was asked, then break the connection.
"""

EVER = 10**9


@dataclass
class Fault:
    """Trouble for the next requests of a route."""

    route: str
    """Name of the route (see `tests.support.hub.routes.ROUTES`); ``*``: any."""
    trouble: Trouble
    times: int = EVER
    """How many requests it befalls."""
    after: int = 0
    """How many requests it spares first."""
    retry_after: int | None = None
    """Seconds of the ``Retry-After`` header of a status; None: no such header."""
    message: str = ""
    """The error message of the response."""


class Faults:
    """The faults still to come, and the count of requests per route."""

    def __init__(self) -> None:
        self.requests: Counter[str] = Counter()
        self._pending: list[Fault] = []
        self._lock = threading.Lock()

    def add(self, fault: Fault) -> None:
        """Append a fault; the first one that fits a request befalls it."""
        with self._lock:
            self._pending.append(fault)

    def clear(self) -> None:
        """Forget all faults and counts."""
        with self._lock:
            self._pending.clear()
            self.requests.clear()

    def take(self, route: str) -> Fault | None:
        """Count a request; return the fault that befalls it."""
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
