"""Two independent computations of a gradient step in two threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache

import torch


def run_parallel[A, B](first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
    """Run two independent computations at once, each with half of torch's threads.

    Small operations gain little from a second thread; two independent computations keep two threads
    busy. With one torch thread they run one after the other.

    ``second`` runs in another thread and does not inherit contexts (autograd, autocast). If both
    fail, the error of ``first`` is raised.
    """
    threads = torch.get_num_threads()
    if threads == 1:
        return first(), second()

    def in_thread() -> B:
        torch.set_num_threads(threads // 2)
        return second()

    torch.set_num_threads(threads - threads // 2)
    task = _thread().submit(in_thread)
    try:
        result = first()
    finally:
        wait([task])
        torch.set_num_threads(threads)
    return result, task.result()


@cache
def _thread() -> ThreadPoolExecutor:
    # An outermost autocast context is kept open: leaving it would clear the cast cache of all
    # threads, so that some weights would be cast, and their gradients rounded, twice.
    return ThreadPoolExecutor(1, "run_parallel", torch.autocast_increment_nesting)
