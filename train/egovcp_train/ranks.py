"""The processes that train together, as ``accelerate launch`` or ``torchrun`` starts them.

Each holds all weights and a part of every batch. What one of them must decide alone (the clock,
what a resumed run continues) the first one does; what all must do together (stop, step) they
agree on. Only the first writes, evaluates and speaks.
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

PATIENCE: Final = timedelta(hours=24)  # the others wait while the first evaluates


class Ranks:
    """One process on its own."""

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
        """Whether this process writes, evaluates and speaks."""
        return self.rank == 0

    def rows(self, batch_size: int) -> slice:
        """Those of this process, ``batch_size`` of them, in a batch that all draw alike."""
        return slice(self.rank * batch_size, (self.rank + 1) * batch_size)

    def decided[T](self, value: T) -> T:
        """The first process' value, given to each; the others wait for it."""
        return value

    def collected[T](self, value: T) -> list[T]:
        """Every process' value in their order, on the first; nothing on the others."""
        return [value]

    def agreed(self, progress: float, stopped: bool) -> tuple[float, bool]:
        """The first process' progress, and whether any of them was asked to stop."""
        return progress, stopped

    def add_up(self, parameters: Iterable[Tensor], terms: Terms) -> Terms:
        """Sum gradients, in place, and scalar terms over the processes."""
        return terms

    def close(self) -> None:
        """Wait until all are done."""


ALONE: Final = Ranks()


class LaunchedRanks(Ranks):
    """Processes with a launcher, connected through torch.distributed."""

    def __init__(self, cpu: bool) -> None:
        """Connect to the others.

        Args:
            cpu: train on the processor even where there is a GPU.

        Raises:
            EnvironmentFailure: accelerate is not installed, or the others cannot be reached.
        """
        require_packages("egovcp-train", "training on several processes", "accelerate")
        from accelerate import PartialState  # a second that a single process should not wait

        try:
            state = PartialState(cpu=cpu, timeout=PATIENCE)
        except (RuntimeError, ValueError) as error:  # torch.distributed has no narrower one
            reason = " ".join(str(error).split())[:200]
            raise EnvironmentFailure(f"cannot connect the processes ({reason})") from error
        self.rank, self.count = state.process_index, state.num_processes
        self.local = int(os.environ.get("LOCAL_WORLD_SIZE", self.count))
        self.share = DataParallelRank(self.rank, self.count, _summed)

    def decided[T](self, value: T) -> T:
        box = [value]
        dist.broadcast_object_list(box, src=0)
        return box[0]

    def collected[T](self, value: T) -> list[T]:
        found: list[Any] | None = [None] * self.count if self.is_first else None
        dist.gather_object(value, found, dst=0)
        return found or []

    def agreed(self, progress: float, stopped: bool) -> tuple[float, bool]:
        own = torch.tensor([progress if self.is_first else 0.0, stopped], dtype=torch.float64)
        summed, anyone = _summed(own).tolist()
        return summed, anyone > 0

    def add_up(self, parameters: Iterable[Tensor], terms: Terms) -> Terms:
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


def launched() -> bool:
    """Whether a launcher started this process together with others."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1


def join(cpu: bool) -> Ranks:
    """The processes that this one trains with; see `LaunchedRanks`."""
    return LaunchedRanks(cpu) if launched() else ALONE


def _summed(x: Tensor) -> Tensor:
    total = x.detach().clone()
    dist.all_reduce(total)
    return total
