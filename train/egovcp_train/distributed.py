"""Processes that train together, started by ``accelerate launch`` or ``torchrun``.

Each process holds all weights and a part of every batch. The first one keeps the clock, writes,
evaluates and prints. All of them stop and step together.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from datetime import timedelta
from typing import Any, Final

import torch
import torch.distributed as dist
from torch import Tensor

from egovcp.errors import EnvironmentFailure
from egovcp.model.parallel import SINGLE_PROCESS, DataParallelRank
from egovcp.packages import require_packages

type Terms = dict[str, Tensor]

TIMEOUT: Final = timedelta(hours=24)  # the other processes wait while the first evaluates


class ProcessGroup:
    """A single process; `LaunchedGroup` has several."""

    rank: int = 0
    """Number of this process."""
    count: int = 1
    """Number of processes."""
    local: int = 1
    """Processes on this computer, which share its memory."""
    share: DataParallelRank = SINGLE_PROCESS
    """This process' part of a batch."""

    @property
    def is_first(self) -> bool:
        """Whether this process writes, evaluates and prints."""
        return self.rank == 0

    def rows(self, batch_size: int) -> slice:
        """This process' rows, ``batch_size`` of them, of a batch that all processes draw."""
        return slice(self.rank * batch_size, (self.rank + 1) * batch_size)

    def broadcast[T](self, value: T) -> T:
        """The first process' value, on every process."""
        return value

    def gather[T](self, value: T) -> list[T]:
        """Every process' value in their order on the first process; empty on the others."""
        return [value]

    def all_reduce(self, progress: float, stopped: bool) -> tuple[float, bool]:
        """The first process' progress, and whether any process was asked to stop."""
        return progress, stopped

    def sum_gradients(self, parameters: Iterable[Tensor], terms: Terms) -> Terms:
        """Sum gradients, in place, and scalar terms over the processes."""
        return terms

    def close(self) -> None:
        """Wait for all processes."""


SINGLE: Final = ProcessGroup()


class LaunchedGroup(ProcessGroup):
    """Processes with a launcher, connected through torch.distributed."""

    def __init__(self, cpu: bool) -> None:
        """Connect to the others.

        Args:
            cpu: train on the CPU even where there is a GPU.

        Raises:
            EnvironmentFailure: accelerate is not installed, or the connection fails.
        """
        require_packages("egovcp-train", "training on several processes", "accelerate")
        from accelerate import PartialState  # takes a second

        try:
            state = PartialState(cpu=cpu, timeout=TIMEOUT)
        except (RuntimeError, ValueError) as error:  # torch.distributed has no narrower one
            reason = " ".join(str(error).split())[:200]
            raise EnvironmentFailure(f"cannot connect the processes ({reason})") from error
        self.rank, self.count = state.process_index, state.num_processes
        self.local = int(os.environ.get("LOCAL_WORLD_SIZE", self.count))
        self.share = DataParallelRank(self.rank, self.count, _summed)

    def broadcast[T](self, value: T) -> T:
        values = [value]
        dist.broadcast_object_list(values, src=0)
        return values[0]

    def gather[T](self, value: T) -> list[T]:
        found: list[Any] | None = [None] * self.count if self.is_first else None
        dist.gather_object(value, found, dst=0)
        return found or []

    def all_reduce(self, progress: float, stopped: bool) -> tuple[float, bool]:
        own = torch.tensor([progress if self.is_first else 0.0, stopped], dtype=torch.float64)
        summed, stopped_count = _summed(own).tolist()
        return summed, stopped_count > 0

    def sum_gradients(self, parameters: Iterable[Tensor], terms: Terms) -> Terms:
        gradients = [p.grad for p in parameters if p.grad is not None]
        values = list(terms.values())
        flat = _summed(torch.cat([x.reshape(-1).float() for x in (*gradients, *values)]))
        sizes = [x.numel() for x in (*gradients, *values)]
        parts = torch.split(flat, sizes)
        for gradient, part in zip(gradients, parts, strict=False):
            gradient.copy_(part.view_as(gradient))
        return dict(zip(terms, (part[0] for part in parts[len(gradients) :]), strict=True))

    def close(self) -> None:
        dist.barrier()
        dist.destroy_process_group()


def join_processes(cpu: bool) -> ProcessGroup:
    """The processes that a launcher started with this one; see `LaunchedGroup`."""
    return LaunchedGroup(cpu) if int(os.environ.get("WORLD_SIZE", "1")) > 1 else SINGLE


def _summed(x: Tensor) -> Tensor:
    total = x.detach().clone()
    dist.all_reduce(total)
    return total
