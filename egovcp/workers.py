"""What worker processes inherit from the command that starts them."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

_THREAD_LIMITS: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def inherited_by_workers() -> Iterator[None]:
    """Workers start deaf to Ctrl-C, which the main process answers, and with one thread each.

    Enter it around the call that starts the processes, on the main thread.
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
