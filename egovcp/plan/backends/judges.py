"""Judges of plans that compute with the packed planning network."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor

from egovcp.model import Carry
from egovcp.plan.backends.integers import Bytes
from egovcp.plan.backends.network import PlanningNetwork, Root
from egovcp.plan.objective import Worth


class FloatJudge:
    """All candidates of all robots at once, on any device.

    Args:
        network: in floating point.
        compiled: through torch.compile, which takes a minute at the first plan.
    """

    def __init__(self, network: PlanningNetwork[Tensor], compiled: bool = False) -> None:
        self._network = network
        self._worth: Callable[[Root, Tensor, list[Tensor]], Tensor] = network.worth
        if compiled:
            self._worth = torch.compile(network.worth, dynamic=False)

    @torch.no_grad()
    def at(self, carry: Carry) -> Worth:
        """See `Judge`."""
        root = self._network.root(carry)

        @torch.no_grad()
        def worth(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            noise = self._network.noise(actions.shape[-2], generator)
            return self._worth(root, actions, noise)

        return worth


class IntegerJudge:
    """A robot's candidates in as many parts as torch uses threads."""

    def __init__(self, network: PlanningNetwork[Bytes]) -> None:
        self._network = network
        self._threads = torch.get_num_threads()
        self._pool: ThreadPoolExecutor | None = None

    @torch.no_grad()
    def at(self, carry: Carry) -> Worth:
        """See `Judge`."""
        network = self._network
        roots = [_row(network.root(Carry(h, z))) for h, z in _each(carry)]
        sound = carry.h.isfinite().all(1) & carry.z.isfinite().all(1)

        def worth(actions: Tensor, generator: torch.Generator | None) -> Tensor:
            noise = network.noise(actions.shape[-2], generator)
            finite = actions.isfinite().flatten(2).all(-1) & sound[:, None]
            jobs = [
                (root, part.contiguous(), noise)
                for root, rows in zip(roots, actions, strict=True)
                for part in rows.chunk(self._threads)
            ]
            values = torch.cat(self._run(jobs)).view(finite.shape)
            return values.masked_fill(~finite, torch.nan)  # bytes know no NaN

        return worth

    def _run(self, jobs: list[tuple[Root, Tensor, list[Tensor]]]) -> list[Tensor]:
        if self._threads == 1:
            return [self._one(job) for job in jobs]
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self._threads, "planner")
        return list(self._pool.map(self._one, jobs))

    def _one(self, job: tuple[Root, Tensor, list[Tensor]]) -> Tensor:
        with torch.no_grad():  # a thread's own switch
            return self._network.worth(*job)


def _each(carry: Carry) -> list[tuple[Tensor, Tensor]]:
    """The robots' states one by one, (1, ...) each."""
    return [(carry.h[e : e + 1], carry.z[e : e + 1]) for e in range(len(carry.h))]


def _row(root: Root) -> Root:
    """One robot's root without its leading dimensions, (1, 1, n) -> (n,)."""
    values = tuple(x.flatten().contiguous() for x in root.values)
    h, mix, recurrence = (x.flatten().contiguous() for x in root[:3])
    return Root(h, mix, recurrence, values)
