"""Two independent computations at once, each with a part of the processor's threads.

A second thread speeds up few of many small operations; two independent computations keep two busy.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache

import torch


def run_parallel[A, B](first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
    """Both results; one after the other where torch has a single thread.

    ``second`` is computed in a thread of its own, to which contexts (of autograd, of autocast) do
    not reach. Where both fail, it is the error of ``first`` that is raised.
    """
    threads = torch.get_num_threads()
    if threads == 1:
        return first(), second()

    def there() -> B:
        torch.set_num_threads(threads // 2)
        return second()

    torch.set_num_threads(threads - threads // 2)
    task = _thread().submit(there)
    try:
        mine = first()
    finally:
        wait([task])  # nothing goes on behind the caller's back
        torch.set_num_threads(threads)
    return mine, task.result()


@cache
def _thread() -> ThreadPoolExecutor:
    # Never without an autocast context: who leaves the last one of a thread makes all threads
    # forget how weights were cast; some would then be cast, and their gradients rounded, twice.
    return ThreadPoolExecutor(1, "beside", torch.autocast_increment_nesting)
