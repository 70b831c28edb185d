"""One batch in several processes: each holds some of its rows, and together they learn from all.

The losses of the processes, and so their gradients, add up to what one process would find that
holds the whole batch: every mean is over the rows of all of them, and each draws the noise of
the whole batch and keeps that of its own rows.

A context and not an argument, because it concerns every mean and every draw of the losses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor


def _alone(x: Tensor) -> Tensor:
    return x


@dataclass(frozen=True)
class Share:
    """The rows of a batch that this process holds: part ``rank`` of ``ranks`` equal ones."""

    rank: int = 0
    ranks: int = 1
    add_up: Callable[[Tensor], Tensor] = _alone
    """The sum of a tensor over all processes, given to each of them."""


WHOLE: Final = Share()
_SHARE: ContextVar[Share] = ContextVar("share", default=WHOLE)


@contextmanager
def sharing(share: Share) -> Iterator[None]:
    """Losses within are this process' part of those of a batch that is shared like that."""
    token = _SHARE.set(share)
    try:
        yield
    finally:
        _SHARE.reset(token)


def present_share() -> Share:
    """That of the losses which are being computed."""
    return _SHARE.get()


def over_all_rows(count: Tensor) -> Tensor:
    """A sum over this process' rows -> over the rows of the whole batch; not differentiable."""
    return _SHARE.get().add_up(count)


def row_noise(
    shape: Sequence[int], generator: torch.Generator | None, device: torch.device
) -> Tensor:
    """Standard normal noise (B, ...) for this process' rows, cut from that of the whole batch."""
    share, rows = _SHARE.get(), shape[0]
    whole = torch.randn((share.ranks * rows, *shape[1:]), generator=generator, device=device)
    return whole[share.rank * rows :][:rows]
