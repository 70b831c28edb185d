"""Data-parallel losses of two processes, computed in two threads."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from torch import Tensor

from egovcp.model.parallel import DataParallelRank


def in_two_processes[T](work: Callable[[DataParallelRank], T]) -> list[T]:
    """Run both processes' work, each in a thread, with a sum over the two."""
    barrier = threading.Barrier(2, timeout=60)
    given: dict[int, Tensor] = {}

    def run(rank: int) -> T:
        def add_up(x: Tensor) -> Tensor:
            given[rank] = x
            barrier.wait()
            total = given[0] + given[1]
            barrier.wait()  # nobody overwrites what the other has yet to read
            return total

        return work(DataParallelRank(rank, 2, add_up))

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(run, range(2)))
