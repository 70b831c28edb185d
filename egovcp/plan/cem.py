"""The cross-entropy method: the next round is drawn around the best of this one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from egovcp.plan.config import PlannerConfig
from egovcp.plan.search import SearchState, best_of, draw, white


@dataclass(frozen=True)
class CrossEntropy:
    """Mean and deviation are refitted to the elites; the answer is their mean."""

    config: PlannerConfig

    def propose(self, state: SearchState, iteration: int, generator: torch.Generator) -> Tensor:
        """See `Optimiser`; standing still is always among the candidates."""
        noise = white(state.mean, self.config.samples, generator)
        return draw(state.mean, state.std, noise)

    def learn(self, state: SearchState, deltas: Tensor, values: Tensor) -> SearchState:
        """See `Optimiser`."""
        elites, top = best_of(deltas, values, self.config.elites)
        usable = top.isfinite()
        mean, std = refit(elites, usable, state)
        value = mean_value(top, usable)
        return SearchState(mean, std.clamp_min(self.config.min_std), elites, top, value)


def refit(elites: Tensor, usable: Tensor, state: SearchState) -> tuple[Tensor, Tensor]:
    """Mean and deviation (E, N, 7) of the usable elites (E, elites, N, 7); without any, the old."""
    if everything(usable):
        mean = elites.sum(1) / elites.shape[1]
        squares = (elites - mean[:, None]).square_()
        return mean, (squares.sum(1) / elites.shape[1]).sqrt_()
    weight = usable[:, :, None, None].to(elites.dtype)
    count = weight.sum(1)
    fitted = (elites * weight).sum(1) / count.clamp_min(1.0)
    squares = (elites - fitted[:, None]).square() * weight
    spread = (squares.sum(1) / count.clamp_min(1.0)).sqrt()
    mean = torch.where(count > 0, fitted, state.mean)
    return mean, torch.where(count > 0, spread, state.std)


def mean_value(top: Tensor, usable: Tensor) -> Tensor:
    """Mean (E,) of the usable ones of (E, elites); -inf without any."""
    if everything(usable):
        return top.sum(1) / top.shape[1]
    value = top.masked_fill(~usable, 0.0).sum(1) / usable.sum(1).clamp_min(1)
    return value.masked_fill(~usable.any(1), -torch.inf)


def everything(usable: Tensor) -> bool:
    """Whether all are, for which less has to be computed to the same bits; asked on processors
    only, for the answer of another device would have to be waited for."""
    return usable.device.type == "cpu" and bool(usable.all())
