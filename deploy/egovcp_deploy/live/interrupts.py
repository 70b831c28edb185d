"""Ctrl-C on the wall clock, where it must not end a program in the middle of a step."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupts:
    """Counts Ctrl-C: the first asks for a graceful end, the second for an immediate one."""

    def __init__(self) -> None:
        self.count = 0

    @contextmanager
    def caught(self) -> Iterator[None]:
        """While this lasts, an interrupt is counted and raises nothing."""
        before = signal.signal(signal.SIGINT, self._count)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    def _count(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
