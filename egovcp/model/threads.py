"""Who gets the processor's threads: two computations at once, or a single one.

Of many small operations a second thread helps with few. Two that have nothing to do with each other
keep two busy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache

import torch


def beside[A, B](first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
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


@contextmanager
def one_thread() -> Iterator[None]:
    """What is computed within is too small to be shared: threads would wait for each other, and
    beside another busy program for long."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@cache
def _thread() -> ThreadPoolExecutor:
    # Never without an autocast context: who leaves the last one of a thread makes all threads
    # forget how weights were cast; some would then be cast, and their gradients rounded, twice.
    return ThreadPoolExecutor(1, "beside", torch.autocast_increment_nesting)
