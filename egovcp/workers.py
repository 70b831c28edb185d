"""Worker processes: what they inherit, their errors, and graceful stops."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
from collections.abc import Iterator, Sequence
from types import FrameType
from typing import Final

from egovcp.entry_point import raise_interrupt

_THREAD_LIMITS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextlib.contextmanager
def inherited_by_workers() -> Iterator[None]:
    """Processes started in the block ignore SIGINT and use one compute thread each.

    Enter it on the main thread.
    """
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    limits = {name: "1" for name in _THREAD_LIMITS if name not in os.environ}
    os.environ.update(limits)
    try:
        yield
    finally:
        for name in limits:
            del os.environ[name]
        signal.signal(signal.SIGINT, previous)


@contextlib.contextmanager
def stop_on_signal(
    signals: Sequence[signal.Signals] = (signal.SIGINT, signal.SIGTERM),
    interrupt: bool = True,
) -> Iterator[list[int]]:
    """A list that is empty until one of ``signals`` arrives; a second signal raises at once.

    Enter it on the main thread. The block checks the list, saves its results, and raises
    KeyboardInterrupt.

    Args:
        interrupt: whether a second signal raises KeyboardInterrupt; else it is added to the list.
    """
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        if received and interrupt:
            raise_interrupt(number, frame)
        received.append(number)

    previous = {s: signal.signal(s, note) for s in signals}
    try:
        yield received
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def is_picklable(error: Exception) -> bool:
    """Whether another process can receive the error."""
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 - bytes made in this expression
    except Exception:  # noqa: BLE001 - an exception class may raise anything here
        return False
    return True
