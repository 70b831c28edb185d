"""Rate, jitter and loss of messages, from the times at which they arrived."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from itertools import takewhile
from typing import Final

import numpy as np

from egovcp.rate import NS_PER_S

WINDOW_S: Final = 1.0
_MOST_KEPT: Final = 5000  # arrivals, 10 s at 500 Hz


@dataclass(frozen=True)
class ArrivalStats:
    """What arrived within a window."""

    rate_hz: float = 0.0
    """Usable messages per second."""
    jitter_ms: float = 0.0
    """99th percentile of |interval - median interval|."""
    gap_ms: float = 0.0
    """Longest time without a usable message, up to now."""
    lost: float = 0.0
    """Share of the messages that were sent but did not arrive, or not usably, in [0, 1]."""


class Arrivals:
    """Remembers when messages arrived. May be filled in one thread and read in another.

    Args:
        numbered: whether the messages carry sequence numbers, so that missing ones are reported
            through `lost`; else they are estimated from intervals of several medians.
    """

    def __init__(self, numbered: bool = False) -> None:
        self._numbered = numbered
        self._lock = threading.Lock()
        self._times: deque[int] = deque(maxlen=_MOST_KEPT)
        self._losses: deque[tuple[int, int]] = deque(maxlen=_MOST_KEPT)

    def arrived(self, time_ns: int) -> None:
        """A usable message arrived at ``time_ns``, monotonic."""
        with self._lock:
            self._times.append(time_ns)

    def lost(self, time_ns: int, count: int = 1) -> None:
        """``count`` messages are known to be lost, or were not usable."""
        with self._lock:
            self._losses.append((time_ns, count))

    def stats(self, now_ns: int, window_s: float = WINDOW_S) -> ArrivalStats:
        """Of the last ``window_s`` seconds."""
        begin = now_ns - round(window_s * NS_PER_S)
        with self._lock:
            newest_first = takewhile(lambda t: t > begin, reversed(self._times))
            times = np.array(list(newest_first)[::-1], np.int64)
            recent = takewhile(lambda loss: loss[0] > begin, reversed(self._losses))
            lost = sum(count for _, count in recent)
        if not len(times):
            return ArrivalStats(gap_ms=window_s * 1e3, lost=1.0)
        intervals = np.diff(times) / 1e6
        if not self._numbered and len(intervals):  # messages that are not usable leave gaps too
            gaps = np.rint(intervals / np.median(intervals) - 1.0).clip(min=0.0).sum()
            lost = max(lost, int(gaps))
        gap = max(float(intervals.max(initial=0.0)), (now_ns - int(times[-1])) / 1e6)
        jitter = 0.0
        if len(intervals):
            jitter = float(np.percentile(np.abs(intervals - np.median(intervals)), 99))
        return ArrivalStats(len(times) / window_s, jitter, gap, lost / (lost + len(times)))
