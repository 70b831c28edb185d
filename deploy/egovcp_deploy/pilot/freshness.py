"""How old a reading is, judged by when its content last changed.

A driver that has died behind a live connection repeats its last reading for ever, with a new
time stamp each time. Real sensors are noisy: readings that repeat bit for bit are not new. Depth
images without a single measured pixel are the exception: with nothing in range all are alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class Freshness:
    """Remembers the last content and when it came."""

    def __init__(self) -> None:
        self._content: bytes | None = None
        self._time_ns: int | None = None
        self._changed_ns: int | None = None

    def update(self, time_ns: int, content: NDArray[np.generic] | None) -> None:
        """Content as read at ``time_ns``; None, or numbers that are not finite, is nothing new."""
        if content is None or not np.isfinite(content).all():
            return
        raw = content.tobytes()
        if raw != self._content or (time_ns != self._time_ns and not content.any()):
            self._content, self._changed_ns = raw, time_ns
        self._time_ns = time_ns

    def age_s(self, now_ns: int) -> float:
        """Since the content last changed, s; infinite before there was any."""
        if self._changed_ns is None:
            return float("inf")
        return (now_ns - self._changed_ns) / 1e9
