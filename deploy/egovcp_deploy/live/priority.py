"""Scheduling priority of threads that must be on time.

Real-time scheduling (SCHED_FIFO) needs root, CAP_SYS_NICE or a limit in
``/etc/security/limits.conf`` (``rtprio``). Where it is refused, a lower nice value is tried; with
autogrouping (the default of most distributions) that only counts among the threads of a session.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Final

#: Of threads that receive, and of those that nothing may delay. Below the kernel's own, 50.
RECEIVING: Final = 10
CONTROL: Final = 20
_NICE: Final = -10


def raise_priority(level: int) -> bool:
    """Give the calling thread, and the threads that it starts from now on, real-time priority.

    Args:
        level: 1 to 99.

    Returns:
        whether it was granted.
    """
    thread = threading.get_native_id()
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(level))
    except (AttributeError, OSError):  # the former: not Linux
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, thread, _NICE)
        return False
    return True


@contextmanager
def raised_priority(level: int) -> Iterator[None]:
    """Start threads in it: they inherit the priority, and the calling thread has its own again."""
    with ExitStack() as stack:
        with suppress(AttributeError, OSError):
            policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(level))
            stack.callback(os.sched_setscheduler, 0, policy, parameter)
        yield
