"""Parallel computation of the losses: two threads of one process, or several processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from typing import Final

import torch
from torch import Tensor


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


def _identity(x: Tensor) -> Tensor:
    return x


@dataclass(frozen=True)
class DataParallelRank:
    """The rows of a batch that this process holds: part ``rank`` of ``ranks`` equal parts.

    Every mean is over the rows of all processes, and each process samples the noise of the whole
    batch and keeps that of its rows. So losses and gradients of the processes sum to those of one
    process that holds the whole batch.
    """

    rank: int = 0
    ranks: int = 1
    all_reduce: Callable[[Tensor], Tensor] = _identity
    """Sum of a tensor over all processes."""


SINGLE_PROCESS: Final = DataParallelRank()
_RANK: ContextVar[DataParallelRank] = ContextVar("rank", default=SINGLE_PROCESS)


@contextmanager
def data_parallel(rank: DataParallelRank) -> Iterator[None]:
    """Compute the losses within as part of a batch that several processes share.

    A context instead of an argument, because it affects every mean and every noise sample.
    """
    token = _RANK.set(rank)
    try:
        yield
    finally:
        _RANK.reset(token)


def current_rank() -> DataParallelRank:
    """The rank set by `data_parallel`."""
    return _RANK.get()


def over_all_rows(count: Tensor) -> Tensor:
    """Sum over this process' rows -> sum over the rows of all processes; not differentiable."""
    return _RANK.get().all_reduce(count)


def row_noise(
    shape: Sequence[int], generator: torch.Generator | None, device: torch.device
) -> Tensor:
    """Standard normal noise (B, ...) of this process' rows, cut from that of the whole batch."""
    rank, rows = _RANK.get(), shape[0]
    whole = torch.randn((rank.ranks * rows, *shape[1:]), generator=generator, device=device)
    return whole[rank.rank * rows :][:rows]
